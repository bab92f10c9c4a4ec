"""The look of a shape in a picture: its moments, and the coverage of short lines across its edges.

Legend: as in seeing.py; S kinds, F moments, M lines across edges, J samples on each. All lengths
are in pixels, x to the right and y up, in the body frame of a shape.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from tangram_core.arrays import Complex, Floats, Ints
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.sides import Side, sides_of

# Moments z^a conj(z)^b: a turn by t multiplies a moment by e^(i (a - b) t).
POWERS = ((2, 0), (3, 0), (4, 0), (2, 1), (3, 1))
ORDERS: Ints = np.array([a - b for a, b in POWERS])
_STEP = 0.5  # pixels between samples of a line
_CORNER = 1.0  # pixels of an edge beside a corner where no line crosses it
_SHIFT = 0.25  # pixels: step of the finite differences with respect to the pose
_GRID = 24  # parts of a triangle's side, for sums over its area


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines across a shape's edges, as long outside the shape as inside.

    Attributes:
        x, y: (M, J) coordinates of the samples.
        expected: (M,) length of each line that the shape covers, in pixels.
        change: (M, 3) derivative of that length when the shape moves by x, y (pixels) and turns
            (rad) in its body frame, while the lines stay.
        solve: (3, M) pseudo-inverse of `change`: errors of the lines to the least-squares move.
    """

    x: Floats
    y: Floats
    expected: Floats
    change: Floats
    solve: Floats


@dataclass(frozen=True, eq=False)
class Kind(Side):
    """A shape with one of its sides up, in pixels.

    Attributes:
        moments: (F,) moments, divided by powers of the area so that size does not matter.
    """

    moments: Complex

    @cached_property
    def perimeter(self) -> float:
        """Perimeter in pixels."""
        z = self.corners @ (1.0, 1j)
        return float(np.abs(np.roll(z, -1) - z).sum())


@lru_cache(maxsize=8)
def kinds_of(layout: Layout, arena: float, pixels: int) -> tuple[Kind, ...]:
    """The distinct shapes of a layout in pixels; chiral shapes with either side up."""
    unit = pixels / arena
    kinds = []
    for side in sides_of(layout):
        corners, area = side.corners * unit, side.area * unit**2
        own = moments_of(*_filled(corners), area)
        kinds.append(
            Kind(side.shape, side.flipped, corners, side.different, area, side.tokens, own)
        )
    return tuple(kinds)


def moments_of(z: Complex, weight: Floats, area: float) -> Complex:
    """(F,) moments of weighted points (M,) around the origin, independent of their size."""
    return np.array(
        [(weight * z**a * z.conj() ** b).sum() / area ** (1 + (a + b) / 2) for a, b in POWERS]
    )


def _filled(corners: Floats) -> tuple[Complex, Floats]:
    """Points that fill a convex polygon, and the area that each stands for."""
    points = corners @ (1.0, 1j)
    ends = np.stack([points, np.roll(points, -1)])  # triangles from the origin
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(_GRID), np.arange(_GRID)))
    low, high = i + j < _GRID, i + j < _GRID - 1
    u = np.concatenate([i[low] + 1 / 3, i[high] + 2 / 3]) / _GRID
    v = np.concatenate([j[low] + 1 / 3, j[high] + 2 / 3]) / _GRID
    z = (u[:, None] * ends[0] + v[:, None] * ends[1]).ravel()
    areas = (ends[0].conj() * ends[1]).imag / 2.0 / _GRID**2
    return z, np.broadcast_to(areas, (len(u), len(points))).ravel()


@lru_cache(maxsize=64)
def lines_of(kind: Kind, reach: float) -> Lines:
    """Lines across a kind's edges that reach `reach` pixels in and out."""
    offset = np.arange(-reach, reach + _STEP / 2, _STEP)
    xs, ys = [], []
    for start, end in zip(kind.corners, np.roll(kind.corners, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        along, out = (end - start) / length, np.array([end[1] - start[1], start[0] - end[0]])
        margin = min(_CORNER, length / 4.0)
        count = max(2, int(np.ceil(length - 2.0 * margin)))
        place = start + np.linspace(margin, length - margin, count)[:, None] * along
        samples = place[:, None] + offset[:, None] * (out / length)
        xs.append(samples[..., 0])
        ys.append(samples[..., 1])
    x, y = np.concatenate(xs), np.concatenate(ys)
    moves = np.array([(_SHIFT, 0, 0), (0, _SHIFT, 0), (0, 0, _SHIFT / 10.0)])
    change = np.stack(
        [
            (_covered(kind.corners, x, y, move) - _covered(kind.corners, x, y, -move))
            / (2.0 * move.max())
            for move in moves
        ],
        axis=1,
    )
    expected = _covered(kind.corners, x, y, np.zeros(3))
    return Lines(x, y, expected, change, np.linalg.pinv(change))


def _covered(corners: Floats, x: Floats, y: Floats, move: Floats) -> Floats:
    """(M,) length of lines covered by a polygon after a move by x, y and turn, in pixels."""
    z = (x - move[0] + 1j * (y - move[1])) * np.exp(-1j * move[2])
    level = np.ones(x.shape)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = end - start
        depth = (edge[0] * (z.imag - start[1]) - edge[1] * (z.real - start[0])) / np.hypot(*edge)
        level = np.minimum(level, np.clip(0.5 + depth, 0.0, 1.0))
    covered: Floats = level.sum(axis=-1) * _STEP
    return covered
