"""Transforms and outlines as SVG writes them into attributes; all of straight lines.

Every function raises ConfigError for text that it cannot read; `where` is what the error calls it.
"""

import re

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.puzzles.sketches import shown

MAX_NUMBERS = 64  # of one attribute
MAX_TEXT = 4096  # characters of one attribute
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_TRANSFORM = r"(\w+)\s*\(([^()]*)\)"
_COUNTS = {
    "matrix": (6,),
    "translate": (1, 2),
    "scale": (1, 2),
    "rotate": (1, 3),
    "skewX": (1,),
    "skewY": (1,),
}


def transform_matrix(text: str, where: str) -> Floats:
    """The matrix (3, 3) of transforms, those on the right applied first."""
    motion = np.eye(3)
    _check_length(text, where)
    if re.sub(_TRANSFORM, "", text).strip(", \t\r\n"):
        raise ConfigError(f"{where}: transform {shown(text)} cannot be read: check its brackets")
    for kind, inside in re.findall(_TRANSFORM, text):
        values = _numbers(inside, f"{where}, transform {kind}")
        if len(values) not in _COUNTS.get(kind, ()):
            raise ConfigError(
                f"{where}: a transform must be matrix, translate, scale, rotate or skew with its "
                f"numbers, got {shown(f'{kind}({inside})')}: apply it to the points"
            )
        motion = motion @ _matrix(kind, values)
    return motion


def _matrix(kind: str, values: list[float]) -> Floats:
    a, b, c, d, e, f = 1.0, 0.0, 0.0, 1.0, 0.0, 0.0
    if kind == "matrix":
        a, b, c, d, e, f = values
    elif kind == "translate":
        e, f = (*values, 0.0)[:2]
    elif kind == "scale":
        a, d = values[0], values[-1]
    elif kind == "skewX":
        c = np.tan(np.radians(values[0]))
    elif kind == "skewY":
        b = np.tan(np.radians(values[0]))
    else:
        angle = np.radians(values[0])
        x, y = values[1:] or (0.0, 0.0)
        a, b, c, d = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
        e, f = x - a * x - c * y, y - b * x - d * y
    return np.array([[a, c, e], [b, d, f], [0.0, 0.0, 1.0]])


def length(text: str, where: str) -> float:
    """One number in the drawing's own units, which may be called px."""
    _check_length(text, where)
    values = _numbers(text.strip().removesuffix("px"), where)
    if len(values) != 1:
        raise ConfigError(
            f"{where}: must be one number, got {shown(text)}: write it without a unit"
        )
    return values[0]


def rect_points(x: float, y: float, width: float, height: float) -> Floats:
    """Corners (4, 2) of a <rect>."""
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


def polygon_points(text: str, where: str) -> Floats:
    """Corners (V, 2) of the attribute `points`."""
    _check_length(text, where)
    values = _numbers(text, where)
    if len(values) % 2:
        raise ConfigError(f"{where}: points must be pairs, got {len(values)} numbers: add one")
    return np.array(values).reshape(-1, 2)


def path_points(text: str, where: str) -> Floats:
    """Corners (V, 2) of the attribute `d`, one outline of M, L, H, V and Z in either case."""
    _check_length(text, where)
    steps = re.findall(r"([a-zA-Z])([^a-dA-Df-zF-Z]*)", text)
    if not steps or steps[0][0] not in "Mm" or not text.lstrip().startswith(steps[0][0]):
        raise ConfigError(f"{where}: a path must start with M, got {shown(text)}")
    x, y, points = 0.0, 0.0, list[tuple[float, float]]()
    for i, (command, inside) in enumerate(steps):
        if command not in "MmLlHhVvZz" or (command in "Mm" and i > 0):
            raise ConfigError(
                f"{where}: a path must be one outline of M, L, H, V, Z, got {command} at step "
                f"{i + 1}: draw straight lines, one piece per path"
            )
        if command in "Zz" and i + 1 < len(steps):
            raise ConfigError(f"{where}: a path must end with its first Z: draw one piece per path")
        for values in _grouped(command, _numbers(inside, where), where):
            x, y = _moved(command, x, y, values)
            points.append((x, y))
    return np.array(points)


def _grouped(command: str, values: list[float], where: str) -> list[list[float]]:
    """The numbers of a command, in portions that each give one point."""
    size = {"M": 2, "L": 2, "H": 1, "V": 1, "Z": 0}[command.upper()]
    if (size == 0) != (not values) or (size and len(values) % size):
        raise ConfigError(
            f"{where}: {command} takes {f'{size} or a multiple of it' if size else 'no'} numbers, "
            f"got {len(values)}"
        )
    return [values[i : i + size] for i in range(0, len(values), max(size, 1))]


def _moved(command: str, x: float, y: float, values: list[float]) -> tuple[float, float]:
    start_x, start_y = (x, y) if command.islower() else (0.0, 0.0)
    if command in "Hh":
        return start_x + values[0], y
    if command in "Vv":
        return x, start_y + values[0]
    return start_x + values[0], start_y + values[1]


def _check_length(text: str, where: str) -> None:
    if len(text) > MAX_TEXT:
        raise ConfigError(
            f"{where}: an attribute must have at most {MAX_TEXT} characters, got {len(text)}: "
            "draw straight lines with fewer digits"
        )


def _numbers(text: str, where: str) -> list[float]:
    """Finite numbers, separated by blanks, commas or their signs."""
    if re.sub(_NUMBER, "", text).strip(", \t\r\n"):
        raise ConfigError(f"{where}: numbers cannot be read from {shown(text)}")
    values = [float(number) for number in re.findall(_NUMBER, text)]
    if len(values) > MAX_NUMBERS:
        raise ConfigError(
            f"{where}: at most {MAX_NUMBERS} numbers, got {len(values)}: draw straight lines"
        )
    if not np.isfinite(values).all():
        raise ConfigError(f"{where}: numbers must be finite, got {shown(text)}")
    return values
