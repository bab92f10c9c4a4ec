"""Trace the outline of a silhouette in a picture as straight sides and corners.

The line where coverage is 0.5 runs around the silhouette. Dynamic programming cuts the chain of its
points into straight sides. A fixed cost for each side keeps their number small. Sides of touching
tans run at multiples of 45 degrees to each other; sides that nearly do so are turned to that.

Points and directions are complex numbers here, in pixels from the picture's upper left corner, y
up. Legend: P pixels along a side, n points of a chain.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import contourpy
import numpy as np
import shapely
from shapely import Polygon

from tangram_core.arrays import Complex, Floats, Singles
from tangram_sim.geometry.areas import Area

_MARGIN = 3  # pixels around a picture
_SHORT = 10  # points: a chain of no more is ignored
_MOST = 4_000  # points of all chains, at most: seven tans of 60 pixels have less than half of it
_DUST = 6.0  # square pixels: a smaller ring is ignored
_ROUNDED = 1  # points beside a corner that are ignored, since blur rounds the corner
_PARALLEL = np.radians(12.0)
_ONE_LINE = 0.5  # pixels between two sides that count as one
_GRID = np.radians(6.0)  # angle between a side and the common grid, at most
_SHORT_SIDE, _SHORT_OFF = 8.0, np.radians(16.0)  # the same for sides of few pixels


@dataclass(frozen=True)
class Way:
    """Settings for cutting a chain of points into sides.

    Attributes:
        spread: usual distance of points from their side, in pixels.
        cost: cost of one more side, in squares of `spread`.
        grid: whether sides are turned to multiples of 45 degrees to each other.
    """

    spread: float
    cost: float
    grid: bool


# The settings that are tried, the most successful first.
WAYS = tuple(
    Way(spread, cost, grid)
    for spread, cost in ((0.06, 14.0), (0.06, 8.0), (0.1, 14.0), (0.06, 25.0), (0.15, 20.0))
    for grid in (True, False)
)


@dataclass
class _Side:
    """A straight side.

    Attributes:
        middle: a point on it.
        along: its direction, a complex number of length 1.
        length: its length in pixels.
        first, last: the points of the chain where it begins and ends.
    """

    middle: complex
    along: complex
    length: float
    first: complex
    last: complex

    def beside(self, point: complex) -> float:
        """How far a point lies from its line."""
        return abs(((point - self.middle) * self.along.conjugate()).imag)

    def foot(self, point: complex) -> complex:
        """The point of its line that is nearest."""
        return self.middle + self.along * ((point - self.middle) * self.along.conjugate()).real


def outline(cover: Singles, way: Way) -> Area:
    """The outline of the silhouette in coverage (P, P); empty if the outline is too rugged."""
    every = _chains(cover)
    if sum(map(len, every)) > _MOST:
        return Polygon()
    rings = [_sides(z, way) for z in every]
    sides = [side for ring in rings for side in ring]
    if way.grid and sides:
        _turn_to_grid(sides)
    polygons = []
    for ring in rings:
        z = _corners(ring)
        if len(z) >= 3:
            polygon = shapely.make_valid(Polygon(np.column_stack([z.real, z.imag])))
            polygons += [polygon] if polygon.area > _DUST else []
    # A ring within a ring is a hole.
    return reduce(shapely.symmetric_difference, polygons, Polygon())


def _chains(cover: Singles) -> list[Complex]:
    """The closed chains of points (n,) where coverage (P, P) is 0.5."""
    # Padded, so that every chain is closed.
    room = np.pad(cover, _MARGIN)
    lines = contourpy.contour_generator(z=room).lines(0.5)
    corner = complex(_MARGIN - 0.5, 0.5 - _MARGIN)
    every: list[Complex] = [np.asarray(line) @ np.array([1.0, -1j]) - corner for line in lines]
    return [z[:-1] for z in every if len(z) > _SHORT and abs(z[0] - z[-1]) < 1e-9]


def _sides(z: Complex, way: Way) -> list[_Side]:
    """The sides of a chain; two attempts find a corner to begin with, the third counts."""
    start = 0
    for attempt in range(3):
        own = np.append(np.roll(z, -start), z[start])
        cuts = _cuts(own, way)
        if attempt < 2:
            start = (start + (cuts[len(cuts) // 2] if len(cuts) > 2 else len(z) // 3)) % len(z)
    return [_side(own, first, last) for first, last in itertools.pairwise(cuts)]


def _cuts(z: Complex, way: Way) -> list[int]:
    """Numbers of the points of an open chain (n,) where its sides begin and end."""
    x, y = z.real - z.real.mean(), z.imag - z.imag.mean()
    columns = (np.ones(len(z)), x, y, x * x, x * y, y * y)
    sums: Floats = np.stack([np.concatenate([[0.0], np.cumsum(one)]) for one in columns])
    best, before = np.zeros(len(z)), np.zeros(len(z), np.int64)
    for last in range(1, len(z)):
        # Sides from every point before to this one, without their ends.
        count, x_sum, y_sum, xx, xy, yy = sums[:, last, None] - sums[:, 1 : last + 1]
        some = np.maximum(count, 1.0)
        a, c = xx - x_sum * x_sum / some, yy - y_sum * y_sum / some
        b = xy - x_sum * y_sum / some
        off = np.maximum((a + c) / 2.0 - np.hypot((a - c) / 2.0, b), 0.0)
        cost = best[:last] + off / way.spread**2 + way.cost
        before[last] = cost.argmin()
        best[last] = cost[before[last]]
    cuts = [len(z) - 1]
    while cuts[-1]:
        cuts.append(int(before[cuts[-1]]))
    return cuts[::-1]


def _side(z: Complex, first: int, last: int) -> _Side:
    """The line through the points of a chain from one corner to the next."""
    few = last - first <= 2 * _ROUNDED + 1
    points = z[first : last + 1] if few else z[first + _ROUNDED : last - _ROUNDED + 1]
    middle = points.mean()
    along = np.exp(0.5j * np.angle(((points - middle) ** 2).sum()))
    way = z[last] - z[first]
    along *= 1.0 if (along.conjugate() * way).real > 0.0 else -1.0
    return _Side(complex(middle), complex(along), abs(way), complex(points[0]), complex(points[-1]))


def _turn_to_grid(sides: Sequence[_Side]) -> None:
    """Turn sides to multiples of 45 degrees to each other, if they are near to that."""
    weight = np.array([side.length for side in sides]) ** 2
    eightfold = np.array([side.along for side in sides]) ** 8
    grid = np.angle((weight * eightfold).sum()) / 8.0
    for _ in range(3):
        off = np.angle(eightfold * np.exp(-8j * grid)) / 8.0
        near = np.abs(off) < 0.7 * _GRID
        if near.any():
            grid += (off * weight)[near].sum() / weight[near].sum()
    for side, far in zip(sides, np.angle(eightfold * np.exp(-8j * grid)) / 8.0, strict=True):
        if abs(far) < (_SHORT_OFF if side.length < _SHORT_SIDE else _GRID):
            side.along *= complex(np.exp(-1j * far))


def _corners(ring: Sequence[_Side]) -> Complex:
    """Corners where sides meet. A step joins parallel sides; sides in line become one."""
    corners: list[complex] = []
    for i, side in enumerate(ring):
        other = ring[i - 1]
        sine = (other.along.conjugate() * side.along).imag
        if abs(sine) >= np.sin(_PARALLEL):
            gap = (side.middle - other.middle) * side.along.conjugate()
            corners.append(other.middle - other.along * (gap.imag / sine))
        elif not (
            other.beside(side.middle) < _ONE_LINE
            and (other.along.conjugate() * side.along).real > 0.0
        ):
            between = (other.last + side.first) / 2.0
            corners += [other.foot(between), side.foot(between)]
    return np.array(corners, np.complex128)
