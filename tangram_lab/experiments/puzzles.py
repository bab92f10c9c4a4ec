"""The package's puzzles, made from their designs: `python -m tangram_lab.experiments.puzzles`.

Writes `tangram_sim/puzzles/*.json` and the contact sheet `docs/images/puzzles.png`. Tans that fill
an outline on the grid are found by search: every unit cell of the grid is cut by both diagonals
into four atoms, and in their upright positions all tans whose small triangles have legs of length
1 are unions of atoms.
"""

import argparse
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image

from tangram_lab.experiments.designs import PAPER, TEST, TRAIN
from tangram_sim.arrays import Floats
from tangram_sim.assembly import Puzzle, PuzzleRules
from tangram_sim.drawing import contact_sheet, draw_scene
from tangram_sim.errors import ConfigError
from tangram_sim.fitting import TOUCHING, fit_piece, overlap_depths
from tangram_sim.puzzles import parse_puzzles
from tangram_sim.sketches import FORMAT, VERSION

Point = tuple[float, float]
Polygon = tuple[Point, ...]
# In grid units, legs of the small triangle of length 1; the letters are those of the designs.
TANS: dict[str, tuple[str, Polygon]] = {
    "L": ("large_triangle", ((0, 0), (2, 0), (0, 2))),
    "M": ("medium_triangle", ((0, 0), (2, 0), (1, 1))),
    "S": ("small_triangle", ((0, 0), (1, 0), (0, 1))),
    "Q": ("square", ((0, 0), (1, 0), (1, 1), (0, 1))),
    "P": ("parallelogram", ((0, 0), (1, 0), (2, 1), (1, 1))),
    "R": ("parallelogram", ((1, 0), (2, 0), (1, 1), (0, 1))),
}


def inside(point: Point, ring: Sequence[Point]) -> bool:
    """Whether a point lies in a polygon, by the parity of crossings; not meant for its border."""
    x, y = point
    crossings = 0
    for (x0, y0), (x1, y1) in zip(ring, (*ring[1:], ring[0]), strict=True):
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
            crossings += 1
    return crossings % 2 == 1


def atoms(rings: Sequence[Sequence[Point]]) -> frozenset[Point]:
    """Middles of the atoms in an outline; rings in rings are holes."""
    corners = np.array([corner for ring in rings for corner in ring])
    low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
    cells = product(range(int(low[0]), int(high[0])), range(int(low[1]), int(high[1])))
    middles = [
        (x + 0.5 + dx, y + 0.5 + dy)
        for x, y in cells
        for dx, dy in ((0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3))
    ]
    return frozenset(
        (round(x, 1), round(y, 1))
        for x, y in middles
        if sum(inside((x + 1e-3, y + 1.3e-3), ring) for ring in rings) % 2
    )


@cache
def _turned(letter: str) -> tuple[tuple[Polygon, tuple[Point, ...]], ...]:
    """The four quarter turns of a tan, each with its atoms."""
    turns = []
    shape = np.array(TANS[letter][1], dtype=float)
    for _ in range(4):
        shape = shape @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        outline = tuple((float(x), float(y)) for x, y in shape)
        turns.append((outline, tuple(sorted(atoms([outline])))))
    return tuple(turns)


def tilings(letters: str, area: frozenset[Point]) -> Iterator[list[tuple[str, Polygon]]]:
    """All ways to fill an area of atoms with tans, as pairs of letter and outline."""
    if not letters:
        if not area:
            yield []
        return
    first = min(area, default=None)
    if first is None:
        return
    for letter in sorted(set(letters)):
        rest = letters.replace(letter, "", 1)
        for outline, own in _turned(letter):
            for anchor in own:
                shift = (first[0] - anchor[0], first[1] - anchor[1])
                if any(abs(s - round(s)) > 1e-6 for s in shift):
                    continue
                covered = {(round(x + shift[0], 1), round(y + shift[1], 1)) for x, y in own}
                if covered <= area:
                    moved = tuple((x + round(shift[0]), y + round(shift[1])) for x, y in outline)
                    for tail in tilings(rest, area - covered):
                        yield [(letter, moved), *tail]


def as_array(outline: Polygon) -> Floats:
    """Corners (V, 2)."""
    return np.array(outline, dtype=np.float64)


# Designs as figures, and the files


ROOT = Path(__file__).parents[2]
ARENA = 2.0
GRID = 2.0**0.5 / 4.0  # units of the full square in one grid unit
_NUMBERS: dict[str, float] = {"": 1.0, "r": 2.0**0.5, "h": 0.5**0.5}
_DIGITS = 12  # of a coordinate in the files


def main() -> int:
    """`python -m tangram_lab.experiments.puzzles`; the same version writes the same bytes."""
    program = "python -m tangram_lab.experiments.puzzles"
    argparse.ArgumentParser(prog=program, description=__doc__).parse_args()
    made = {}
    for split, designs in (("train", TRAIN), ("test", TEST), ("paper", PAPER)):
        text = file_text(designs)
        rules = PuzzleRules(subset=split == "paper")
        puzzles = parse_puzzles(text, f"{split}.json", rules).puzzles
        (ROOT / "tangram_sim" / "puzzles" / f"{split}.json").write_text(text, encoding="utf-8")
        made[split] = puzzles
    picture = sheet([*made["train"], *made["test"]])
    picture.save(ROOT / "docs" / "images" / "puzzles.png", optimize=True)
    return 0


def file_text(designs: Mapping[str, str]) -> str:
    """The puzzle file of designs, one line for each piece."""
    puzzles = ",\n".join(_puzzle_text(name, design) for name, design in designs.items())
    head = f'"format": "{FORMAT}", "version": {VERSION}'
    return f'{{{head}, "puzzles": [\n{puzzles}\n]}}\n'


def _puzzle_text(name: str, design: str) -> str:
    try:
        pieces = figure_pieces(design)
        _check_exact(pieces)
    except ConfigError as error:
        raise ConfigError(f"figure '{name}': {error}") from None
    lines = [
        json.dumps({"shape": kind, "corners": (np.round(corners, _DIGITS) + 0.0).tolist()})
        for kind, corners in pieces
    ]
    return f'{{"name": {json.dumps(name)}, "pieces": [\n  ' + ",\n  ".join(lines) + "\n]}"


def _check_exact(pieces: list[tuple[str, Floats]]) -> None:
    """Raise ConfigError for a piece that is not its tan or lies in another."""
    residual = max(fit_piece(kind, corners).residual for kind, corners in pieces)
    padded = np.array([corners[[0, 1, 2, -1]] for _, corners in pieces])
    depth = overlap_depths(padded)[0].max()
    if max(residual, depth) > TOUCHING:
        raise ConfigError(
            f"pieces must fit to {TOUCHING:g} units, are {residual:.3g} off their shapes and lie "
            f"{depth:.3g} deep in each other"
        )


def figure_pieces(design: str) -> list[tuple[str, Floats]]:
    """Kinds and corners (V, 2) in units of the pieces of a design; see `designs`."""
    return [piece for part in design.split("/") for piece in _part(part.strip())]


def _part(text: str) -> list[tuple[str, Floats]]:
    """The pieces of one part, turned and moved as a whole."""
    match = re.fullmatch(r"([LMSQPR]+)([^^@]*)(?:\^([0-7]))?\s*(?:@(\S+))?", text)
    if match is None:
        raise ConfigError(f"a part must be 'LETTERS outline ^turn @x,y', got '{text}'")
    letters, outline, turn, place = match.groups()
    rings = [[_point(corner) for corner in ring.split()] for ring in outline.split(";")]
    pieces = _tiles(letters, rings) if rings[0] else [(letters, TANS[letters][1])]
    first = np.array(rings[0][0] if rings[0] else pieces[0][1][0])
    goal = np.array(_point(place)) if place else first
    angle = np.pi / 4.0 * int(turn or 0)
    turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return [
        (TANS[letter][0], GRID * ((as_array(corners) - first) @ turned + goal))
        for letter, corners in pieces
    ]


def _tiles(letters: str, rings: list[list[tuple[float, float]]]) -> list[tuple[str, Polygon]]:
    area = atoms(rings)
    found = next(tilings(letters, area), None)
    if found is None:
        raise ConfigError(f"{letters} do not fill {rings}, whose area is {len(area) / 4:g}")
    return found


def _point(text: str) -> tuple[float, float]:
    x, y = text.split(",")
    return _number(x), _number(y)


def _number(text: str) -> float:
    """A sum of multiples of 1, r (the root of 2) and h (its half): "2-1.5r"."""
    terms = re.findall(r"([-+]?)(\d*\.?\d*)([rh]?)", text)
    return sum(
        float(f"{sign}{factor or 1}") * _NUMBERS[letter]
        for sign, factor, letter in terms
        if factor or letter
    )


def sheet(puzzles: Sequence[Puzzle], columns: int = 7, size: int = 170) -> Image.Image:
    """All figures with their names, all of one scale."""
    scenes = [draw_scene(one.layout, ARENA, one.corners, one.corners, size) for one in puzzles]
    return contact_sheet(scenes, columns, [one.name for one in puzzles])


if __name__ == "__main__":
    sys.exit(main())
