"""One puzzle as an SVG drawing of seven polygons, read without trust.

Counted are <polygon>, <polyline>, <rect> and <path> elements, the latter of straight lines (M, L,
H, V, Z); their own transforms and those of the groups around them apply. Left out are what is
defined but not drawn, what is hidden, and a <rect> as large as the whole drawing: its background.
Rounded corners of a <rect> are taken as sharp, and corners within a straight edge as none.
"""

import re
from collections.abc import Iterator
from xml.etree import ElementTree as ET

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.geometry.fitting import VARIANTS, fit_piece
from tangram_sim.geometry.shapes import MAX_COORDINATE, polygon_area, tan
from tangram_sim.puzzles.sketches import MAX_BYTES, MAX_PIECES, FaultError, Sketch, checked_name
from tangram_sim.puzzles.svg_attributes import (
    length,
    path_points,
    polygon_points,
    rect_points,
    transform_matrix,
)

MAX_DEPTH = 50
MAX_TAGS = 20_000
_OUTLINES = {"polygon", "polyline", "rect", "path"}
_RECT = ("x", "y", "width", "height")
_HIDDEN = re.compile(r"(display\s*:\s*none|visibility\s*:\s*hidden)")
_STRAIGHT = 1e-6  # of a corner, as a share of the drawing's extent
_NOT_DRAWN = {"defs", "symbol", "clipPath", "mask", "marker", "pattern", "metadata"}


@np.errstate(over="ignore", invalid="ignore")  # what overflows is out of bounds later
def parse_svg(text: str, name: str) -> Sketch:
    """The figure of an SVG file; its seven areas together are one squared unit.

    Raises:
        ConfigError: not an SVG that can be read.
        FaultError: its polygons are not the seven tans; the fit is not checked here.
    """
    outlines = [
        _outline(element, motion, f"SVG '{name}', polygon {i + 1}")
        for i, (element, motion) in enumerate(_polygons(_root(text, name), name))
    ]
    where = f"puzzle '{checked_name(name, 'SVG file')}'"
    if len(outlines) != 7:
        raise FaultError(f"{where}: must draw 7 polygons or paths, got {len(outlines)}")
    for i, outline in enumerate(outlines):
        if len(outline) not in (3, 4):
            raise FaultError(
                f"{where}, piece {i + 1}: must have 3 or 4 corners, got {len(outline)}"
            )
    areas = [abs(polygon_area(outline)) for outline in outlines]
    if not sum(areas) > 0.0:
        raise FaultError(f"{where}: its polygons have no area: draw them larger")
    unit = float(np.sqrt(sum(areas)))
    # The y axis of SVG points down.
    units = [outline / (unit, -unit) for outline in outlines]
    return Sketch(name, tuple((_kind(outline), outline) for outline in units))


@np.errstate(over="ignore", invalid="ignore")  # what overflows is out of bounds later
def svg_outlines(text: str, name: str) -> list[Floats]:
    """All outlines (V, 2) that an SVG draws, y up, V >= 3; ConfigError if it draws none."""
    outlines = [
        _outline(element, motion, f"SVG '{name}', polygon {i + 1}") * (1.0, -1.0)
        for i, (element, motion) in enumerate(_polygons(_root(text, name), name))
    ]
    found = [outline for outline in outlines if len(outline) >= 3]
    if not found:
        raise ConfigError(f"SVG '{name}' draws no polygon: draw the outline of a silhouette")
    return found


def _kind(outline: Floats) -> str:
    """The tan of the same number of corners whose size, then shape, is closest to an outline."""
    kinds = [kind for kind in VARIANTS if len(tan(kind).corners) == len(outline)]
    if len(outline) == 4:
        return min(kinds, key=lambda kind: fit_piece(kind, outline).residual)
    size = abs(polygon_area(outline))
    return min(kinds, key=lambda kind: abs(np.sqrt(size) - np.sqrt(tan(kind).area)))


def _root(text: str, name: str) -> ET.Element:
    if len(text) > MAX_BYTES:
        raise ConfigError(f"SVG '{name}' is longer than {MAX_BYTES} characters: simplify it")
    if text.count("<") > MAX_TAGS:
        raise ConfigError(f"SVG '{name}' has more than {MAX_TAGS} tags: draw 7 polygons only")
    if re.search(r"<!\s*(doctype[^<>]*\[|entity)", text, re.IGNORECASE):
        raise ConfigError(
            f"SVG '{name}' must have no ENTITY and no DOCTYPE with [...]: delete them"
        )
    try:
        # Entities are the danger of XML, and none can be defined without a [...] of DOCTYPE.
        root = ET.fromstring(text)  # noqa: S314
    except (ET.ParseError, ValueError) as error:
        raise ConfigError(f"SVG '{name}' is not XML: {error}") from None
    if _tag(root) != "svg":
        raise ConfigError(f"SVG '{name}' must be an <svg> element, got <{_tag(root)}>")
    return root


def _tag(element: ET.Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _polygons(root: ET.Element, name: str) -> Iterator[tuple[ET.Element, Floats]]:
    """Drawn polygons in the file's order, each with its motion (3, 3)."""
    waiting, found = [(root, np.eye(3), 0)], 0
    size = _size(root)
    while waiting:
        element, motion, depth = waiting.pop()
        if depth > MAX_DEPTH:
            raise ConfigError(f"SVG '{name}' nests deeper than {MAX_DEPTH} groups: ungroup it")
        if _tag(element) in _NOT_DRAWN or _is_hidden(element):
            continue
        if _tag(element) == "rect" and _measures(element) in (size, ("100%", "100%")):
            continue
        motion = motion @ transform_matrix(element.get("transform", ""), f"SVG '{name}'")
        if _tag(element) in _OUTLINES:
            found += 1
            if found > MAX_PIECES:
                raise ConfigError(f"SVG '{name}' draws more than {MAX_PIECES} polygons: draw 7")
            yield element, motion
        waiting += [(child, motion, depth + 1) for child in reversed(element)]


def _measures(element: ET.Element) -> tuple[str, str]:
    width, height = (element.get(name, "").strip() for name in ("width", "height"))
    return width.removesuffix("px"), height.removesuffix("px")


def _size(root: ET.Element) -> tuple[str, str]:
    """Width and height of the drawing in its own units, as they are written."""
    box = re.split(r"[\s,]+", root.get("viewBox", "").strip())
    return (box[2], box[3]) if len(box) == 4 else _measures(root)


def _is_hidden(element: ET.Element) -> bool:
    names = ("display", "visibility")
    styles = [element.get("style", ""), *(f"{name}:{element.get(name, '')}" for name in names)]
    return any(_HIDDEN.search(style) for style in styles)


def _outline(element: ET.Element, motion: Floats, where: str) -> Floats:
    """Corners (V, 2) after all transforms, without repetitions."""
    if _tag(element) == "rect":
        points = rect_points(*(length(element.get(n, "0"), f"{where}, {n}") for n in _RECT))
    elif _tag(element) == "path":
        points = path_points(element.get("d", ""), where)
    else:
        points = polygon_points(element.get("points", ""), where)
    points = points @ motion[:2, :2].T + motion[:2, 2]
    if not (np.abs(points) <= MAX_COORDINATE).all():
        raise ConfigError(f"{where} must lie within +-{MAX_COORDINATE:g}: scale it down")
    if len(points) < 2:
        return points
    extent = max(np.ptp(points), 1e-300)
    apart = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    points = points[apart > _STRAIGHT * extent]
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    turns = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    corners: Floats = points[np.abs(turns) > _STRAIGHT * extent**2]
    return corners
