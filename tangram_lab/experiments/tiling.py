"""Tans that fill an outline on the grid, found by search.

Every unit cell of the grid is cut by both diagonals into four atoms. In their upright positions all
tans whose small triangles have legs of length 1 are unions of atoms.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import product

import numpy as np

from tangram_sim.arrays import Floats

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
