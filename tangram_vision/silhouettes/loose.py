"""Places of tokens in an outline that may be wrong: they need not fit.

As in `tangram_sim.geometry.dissections` a token has a corner at a convex one of what is left, with
an edge along the side that leaves it. But it may reach out of what is left, and no part need have
the area of tokens.
"""

from typing import NamedTuple

import numpy as np
import shapely
from shapely import Polygon

from tangram_core.arrays import Complex
from tangram_sim.geometry.areas import Area
from tangram_sim.geometry.dissections import Laid, Tokens, convex_corners, laid_at, parts_of

_OVER = 0.5  # of the smallest token's area that a token may reach out of what is left
_TURN = np.radians(1.0)  # that a corner's angle may be wrong, and more where its sides are short
_CORNERS = 40  # of a part that are looked at: tans leave no more


class LoosePlace(NamedTuple):
    """Where a token may lie.

    Attributes:
        laid: the token in its place.
        polygon: what it covers.
        over: area by which it reaches out of what is left.
    """

    laid: Laid
    polygon: Polygon
    over: float


class _Fit(NamedTuple):
    """The same, of which most is thrown away again: a token's corner, by number, and where it is.

    Attributes:
        corner: number of the corner.
        at: its place, and the direction of the edge that leaves it.
        polygon: see `LoosePlace`.
        over: see there.
    """

    corner: int
    at: tuple[complex, complex]
    polygon: Polygon
    over: float


class LoosePlaces:
    """Finds them for one set of tokens."""

    def __init__(self, tokens: Tokens, tolerance: float) -> None:
        """With a tolerance, in their units: how far sides may be from where they should be."""
        self._tokens, self._tolerance = tokens, tolerance
        self._least = float(tokens.areas.min())
        self._bodies: Complex = np.array([corner.body for corner in tokens.corners])
        self._shape = np.array([corner.shape for corner in tokens.corners])
        self._angle = np.array([corner.angle for corner in tokens.corners])
        self._leaving = np.array([corner.leaving for corner in tokens.corners])

    def __call__(self, rest: Area, left: tuple[int, ...]) -> list[LoosePlace]:
        """What may lie at the corner of what is left where least may, but something."""
        least: list[_Fit] = []
        for part in parts_of(rest, self._least):
            for fits in self._of(part, left):
                if fits and (not least or len(fits) < len(least)):
                    least = fits
        corners = self._tokens.corners
        return [
            LoosePlace(laid_at(corners[fit.corner], *fit.at), fit.polygon, fit.over)
            for fit in least
        ]

    def _of(self, part: Polygon, left: tuple[int, ...]) -> list[list["_Fit"]]:
        """For each convex corner of a part what may lie there."""
        found = list(convex_corners(part, self._tolerance))
        if len(found) > _CORNERS:  # of a rugged outline those with the longest sides
            found = sorted(found, key=lambda one: -min(abs(one[3]), abs(one[4])))[:_CORNERS]
        if not found:
            return []
        point, along, angle, leaving, coming = np.array(found).T[..., None]
        slack = _TURN + 3.0 * self._tolerance / np.minimum(np.abs(leaving), np.abs(coming)).real
        fits = np.array(left)[self._shape] * (self._angle <= angle.real + slack) > 0
        # A negative length is that of a side that may go on straight inside.
        fits &= (leaving.real < 0.0) | (leaving.real >= self._leaving - 2.0 * self._tolerance)
        shapely.prepare(part)
        middle = point + along * self._bodies.mean(axis=1)
        fits &= shapely.contains_xy(part, middle.real, middle.imag)
        rows, corners = np.nonzero(fits)
        z = point[rows] + along[rows] * self._bodies[corners]
        polygons = shapely.polygons(np.stack([z.real, z.imag], axis=-1))
        over = shapely.area(polygons) - shapely.area(shapely.intersection(part, polygons))
        at: list[list[_Fit]] = [[] for _ in found]
        for i in np.flatnonzero(over < _OVER * self._least).tolist():
            row = int(rows[i])
            at[row].append(_Fit(int(corners[i]), found[row][:2], polygons[i], float(over[i])))
        return at
