"""Reading of hand-drawn puzzle files, whose content is not trusted.

A file is JSON: {"format": "tangram-puzzles", "version": 1, "puzzles": [{"name": "cat", "pieces":
[{"shape": "square", "corners": [[x, y], ...]}, ...]}, ...]}. Lengths are in units, the side of the
full square that the tans are cut from. Corners may have any order, anywhere in the plane.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.geometry.fitting import VARIANTS
from tangram_sim.geometry.shapes import MAX_COORDINATE, tan

FORMAT, VERSION = "tangram-puzzles", 1
MAX_BYTES = 4 * 2**20
MAX_PUZZLES = 1000
MAX_NAME = 64
MAX_PIECES = 16
_MAX_SHOWN = 60  # most characters of a wrong value in a message


@dataclass(frozen=True, eq=False)
class Sketch:
    """A drawn figure of K pieces.

    Attributes:
        name: of the puzzle.
        pieces: K pairs of a kind (see `VARIANTS`) and corners (V, 2) in units.
    """

    name: str
    pieces: tuple[tuple[str, Floats], ...]


class FaultError(Exception):
    """A fault of one puzzle; the text says where it is."""


def check_file(path: Path, source: str) -> None:
    """Raise ConfigError unless a path leads to a file; `source` is its name in the error."""
    try:
        there, why = path.is_file(), ""
    except OSError as error:  # a name that is too long, or a folder that may not be read
        there, why = False, f" ({error.strerror})"
    if not there:
        raise ConfigError(f"{source} is no file{why}: check the path")


def read_text(path: Path, source: str | None = None) -> str:
    """The text of a drawing; ConfigError if it is unreadable, too large or not UTF-8."""
    source = source or f"puzzle file {path}"
    check_file(path, source)
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(
            f"{source} cannot be read ({error.strerror}): give a copy that you may read"
        ) from None
    if len(content) > MAX_BYTES:
        raise ConfigError(f"{source} is larger than {MAX_BYTES} bytes: split it, or give a PNG")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(f"{source} is not UTF-8: save it as UTF-8") from None


def parse_sketches(text: str, source: str) -> list[Sketch | list[str]]:
    """For each puzzle of a JSON text, in order: its sketch, or its faults if it is unusable.

    Raises:
        ConfigError: the whole text is unusable; `source` is its name in errors.
    """
    content = loaded(text, source)
    if not isinstance(content, dict) or set(content) != {"format", "version", "puzzles"}:
        raise ConfigError(
            f"{source} must be a mapping with exactly the keys format, version, puzzles, "
            f"got {shown(content)}"
        )
    check_format(content, FORMAT, VERSION, source)
    return _sketches(_entries(content["puzzles"], source))


def loaded(text: str, source: str) -> Any:
    """The content of a JSON text; ConfigError if it is too long, no JSON, or repeats a key."""
    if len(text) > MAX_BYTES:
        raise ConfigError(f"{source} is longer than {MAX_BYTES} characters: split it")
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except FaultError as fault:
        raise ConfigError(f"{source}: {fault}") from None
    except (ValueError, RecursionError) as error:
        place = (
            f"line {error.lineno}{' and the one before' * (error.lineno > 1)}"
            if isinstance(error, json.JSONDecodeError)
            else "its nesting and numbers"
        )
        raise ConfigError(f"{source} is not JSON that can be read: check {place}") from None


def check_format(content: dict[str, Any], name: str, version: int, source: str) -> None:
    """Raise ConfigError unless a file has the given format and version."""
    if content["format"] != name:
        raise ConfigError(f"{source}: format must be '{name}', got {shown(content['format'])}")
    if type(content["version"]) is not int or content["version"] != version:
        raise ConfigError(
            f"{source}: version must be {version}, got {shown(content['version'])}: "
            "write the file anew, or read it with the release that wrote it"
        )


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise FaultError(
            f"a key is given twice among {shown([key for key, _ in pairs])}: remove one"
        )
    return content


def _entries(puzzles: Any, source: str) -> list[Any]:
    if not isinstance(puzzles, list) or not 1 <= len(puzzles) <= MAX_PUZZLES:
        got = len(puzzles) if isinstance(puzzles, list) else shown(puzzles)
        raise ConfigError(f"{source}: puzzles must be a list of 1 to {MAX_PUZZLES}, got {got}")
    return puzzles


def _sketches(entries: list[Any]) -> list[Sketch | list[str]]:
    sketches: list[Sketch | list[str]] = []
    names: set[str] = set()
    for i, entry in enumerate(entries):
        try:
            where = f"puzzle number {i + 1}"
            if not isinstance(entry, dict) or set(entry) != {"name", "pieces"}:
                keys = "must have exactly the keys name, pieces"
                raise FaultError(f"{where} {keys}, got {shown(entry)}")
            name = checked_name(entry["name"], where)
            if name in names:
                raise FaultError(
                    f"{where}: the name '{name}' belongs to an earlier puzzle: rename one"
                )
            names.add(name)
            pieces, wrong = _pieces(entry["pieces"], f"puzzle '{name}'")
            sketches.append(wrong or Sketch(name, pieces))
        except FaultError as fault:
            sketches.append([str(fault)])
    return sketches


def checked_name(name: Any, where: str) -> str:
    """A puzzle's name, checked; FaultError if it is empty, too long or not printable."""
    if not isinstance(name, str) or not 1 <= len(name) <= MAX_NAME or not name.isprintable():
        raise FaultError(
            f"{where}: name must be 1 to {MAX_NAME} printable characters, got {shown(name)}"
        )
    return name


def _pieces(entries: Any, where: str) -> tuple[tuple[tuple[str, Floats], ...], list[str]]:
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_PIECES:
        got = len(entries) if isinstance(entries, list) else shown(entries)
        raise FaultError(f"{where}: pieces must be a list of 1 to {MAX_PIECES}, got {got}")
    pieces, faults = [], []
    for i, entry in enumerate(entries):
        try:
            pieces.append(_piece(entry, f"{where}, piece {i + 1}"))
        except FaultError as fault:
            faults.append(str(fault))
    return tuple(pieces), faults


def _piece(entry: Any, where: str) -> tuple[str, Floats]:
    if not isinstance(entry, dict) or set(entry) != {"shape", "corners"}:
        raise FaultError(f"{where} must have exactly the keys shape, corners, got {shown(entry)}")
    kind, corners = entry["shape"], entry["corners"]
    if not isinstance(kind, str) or kind not in VARIANTS:
        raise FaultError(f"{where}: shape must be one of {', '.join(VARIANTS)}, got {shown(kind)}")
    count = len(tan(kind).corners)
    if not isinstance(corners, list) or len(corners) != count:
        got = len(corners) if isinstance(corners, list) else shown(corners)
        raise FaultError(f"{where} ({kind}): corners must be a list of {count} pairs, got {got}")
    return kind, np.array([drawn_point(corner, f"{where} ({kind})") for corner in corners])


def drawn_point(corner: Any, where: str) -> tuple[float, float]:
    """A corner (x, y), checked; FaultError unless it is a pair of numbers within bounds."""
    if not isinstance(corner, list) or len(corner) != 2 or not all(map(is_number, corner)):
        raise FaultError(
            f"{where}: a corner must be [x, y], finite and within +-{MAX_COORDINATE:g}, "
            f"got {shown(corner)}"
        )
    return float(corner[0]), float(corner[1])


def is_number(value: Any) -> bool:
    """Whether a value is a finite number within +-MAX_COORDINATE."""
    # A whole number may be too large for a float; NaN fails every comparison.
    return type(value) in (int, float) and -MAX_COORDINATE <= value <= MAX_COORDINATE


def shown(value: Any) -> str:
    """A wrong value as a text that is short enough for a message."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # too many digits, or too deep
        return f"a {type(value).__name__}"
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."
