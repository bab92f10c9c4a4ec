"""Read the outline of a silhouette from an untrusted JSON file, or from the library.

A file is a puzzle, whose pieces are merged, or a list of outlines:
{"format": "tangram-outlines", "version": 1, "outlines": [[[x, y], ...], ...], "side": 1},
lengths in any unit, y up. An outline that lies in another is a hole. `side` gives the scale: it is
the side of the full square that the tans are cut from. It may be left out.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import Polygon

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.geometry.areas import Area, grown
from tangram_sim.geometry.overlap import outlines
from tangram_sim.geometry.shapes import MAX_COORDINATE
from tangram_sim.puzzles.assembly import Puzzle, PuzzleRules
from tangram_sim.puzzles.figures import load_puzzle, parse_puzzles
from tangram_sim.puzzles.sketches import (
    FaultError,
    check_format,
    drawn_point,
    is_number,
    loaded,
    read_text,
    shown,
)

FORMAT, VERSION = "tangram-outlines", 1
MAX_OUTLINES = 100
MIN_SIDE = 1e-6
MAX_POINTS = 2_000  # corners of all outlines of a file
# Pairs of sides that meet, without neighbours: seven tans have less than a hundred. The time that
# shapely needs grows faster than the square of their number.
MAX_MEETINGS = 1_000
_KEYS = {"format", "version", "outlines"}
_SEAM = 0.004  # of the root of the area: narrower gaps between drawn pieces are closed


@dataclass(frozen=True, eq=False)
class Drawn:
    """A silhouette and its scale.

    Attributes:
        area: the silhouette, around the origin.
        side: side of the full square that the tans are cut from, in the area's unit; None if
            unknown.
    """

    area: Area
    side: float | None


def read_outline(name: str, source: str) -> Drawn:
    """The silhouette of a file, or of a puzzle of the library.

    Args:
        name: path of the JSON file, or name of the puzzle.
        source: name of the file or puzzle in errors.

    Raises:
        ConfigError: the file or the puzzle cannot be used.
    """
    path, kind = Path(name), Path(name).suffix.lower()
    if kind != ".json":
        return _of_puzzle(load_puzzle(name, 1.0), source)
    text = read_text(path, source)
    content = loaded(text, source)
    if isinstance(content, dict) and (content.get("format") == FORMAT or "outlines" in content):
        return _of_outlines(content, source)
    return _of_puzzle(_only(text, source), source)


def _only(text: str, source: str) -> Puzzle:
    found = parse_puzzles(text, source, PuzzleRules(1.0, subset=True))
    if len(found) != 1:
        raise ConfigError(
            f"{source} has {len(found)} puzzles, but it must have one: use a file with one puzzle"
        )
    return found[0]


def _of_puzzle(puzzle: Puzzle, source: str) -> Drawn:
    pieces = outlines(puzzle.layout.corners(puzzle.poses)[None], puzzle.layout)[0]
    return Drawn(_joined(list(pieces), source), puzzle.scale)


def _of_outlines(content: dict[str, Any], source: str) -> Drawn:
    if set(content) - {"side"} != _KEYS:
        raise ConfigError(
            f"{source} must be a mapping with the keys format, version, outlines, and optionally "
            f"side, got {shown(list(content))}"
        )
    check_format(content, FORMAT, VERSION, source)
    entries, side = content["outlines"], content.get("side", MIN_SIDE)
    if not (is_number(side) and side >= MIN_SIDE):
        raise ConfigError(
            f"{source}: side must be a number from {MIN_SIDE:g} to {MAX_COORDINATE:g}, got "
            f"{shown(side)}: leave it out where it is not known"
        )
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_OUTLINES:
        got = len(entries) if isinstance(entries, list) else shown(entries)
        raise ConfigError(f"{source}: outlines must be a list of 1 to {MAX_OUTLINES}, got {got}")
    try:
        drawn = [_ring(entry, f"{source}, outline {i + 1}") for i, entry in enumerate(entries)]
    except FaultError as fault:
        raise ConfigError(str(fault)) from None
    return Drawn(_joined(drawn, source), float(side) if "side" in content else None)


def _ring(entry: Any, where: str) -> Floats:
    if not isinstance(entry, list) or not 3 <= len(entry) <= MAX_POINTS:
        got = len(entry) if isinstance(entry, list) else shown(entry)
        raise FaultError(f"{where} must be a list of 3 to {MAX_POINTS} corners, got {got}")
    return np.array([drawn_point(corner, where) for corner in entry])


def _joined(rings: list[Floats], source: str) -> Area:
    """One area of several outlines (V, 2). One in another is a hole, one in a hole an island."""
    if sum(map(len, rings)) > MAX_POINTS:
        raise ConfigError(
            f"{source} has more than {MAX_POINTS} corners: draw straight sides, or give a PNG of it"
        )
    if _meetings(rings) > MAX_MEETINGS:
        raise ConfigError(
            f"{source} has sides that meet more than {MAX_MEETINGS} times: draw outlines that do "
            "not cross, or give a PNG of it"
        )
    every = np.concatenate(rings)
    # Far from the origin, coordinates would lose digits.
    middle = (every.min(axis=0) + every.max(axis=0)) / 2.0
    valid = [shapely.make_valid(Polygon(ring - middle)) for ring in rings]
    inside = [sum(shapely.contains_properly(other, one) for other in valid) for one in valid]
    area: Area = Polygon()
    for depth in range(max(inside) + 1):
        own = shapely.union_all([one for one, d in zip(valid, inside, strict=True) if d == depth])
        area = shapely.difference(area, own) if depth % 2 else shapely.union(area, own)
    size = float(np.sqrt(area.area))
    if size > 0.0:
        area = grown(grown(area, _SEAM * size), -_SEAM * size)
    if not area.area > 0.0:
        raise ConfigError(f"{source} draws nothing that has an area: draw an outline")
    return area


def _meetings(rings: list[Floats]) -> int:
    """Count pairs of sides that meet, without neighbours; stop above MAX_MEETINGS."""
    ends = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings]
    sides = shapely.linestrings(np.concatenate(ends))
    starts = np.cumsum([0, *map(len, rings)])
    after = np.concatenate([np.roll(np.arange(a, b), -1) for a, b in pairwise(starts)])
    tree, count = shapely.STRtree(sides), 0
    for i, side in enumerate(sides):
        meet = tree.query(side, predicate="intersects")
        count += int(np.count_nonzero((meet > i) & (meet != after[i]) & (after[meet] != i)))
        if count > MAX_MEETINGS:
            break
    return count
