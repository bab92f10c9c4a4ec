"""Propose places of tokens in an outline that may be wrong; tokens need not fit exactly.

The rest is the area that is left to fill. As in `tangram_sim.geometry.dissections`, a token's
corner is laid onto a convex corner of the rest, with an edge along the side that leaves it. But
here a token may reach out of the rest, and the areas need not add up.
"""

from typing import NamedTuple

import numpy as np
import shapely
from shapely import Polygon

from tangram_core.arrays import Complex
from tangram_sim.geometry.areas import Area
from tangram_sim.geometry.dissections import Laid, Tokens, convex_corners, laid_at, parts_of

_OVER = 0.5  # of the smallest token's area: how much of a token may lie outside of the rest
_TURN = np.radians(1.0)  # error of a corner's angle, at most; more if its sides are short
_CORNERS = 40  # corners of a part that are tried; tans leave no more


class LoosePlace(NamedTuple):
    """A place where a token may lie.

    Attributes:
        laid: the token in its place.
        polygon: the area that the token covers.
        over: area of the token outside of the rest.
    """

    laid: Laid
    polygon: Polygon
    over: float


class _Fit(NamedTuple):
    """A cheap form of `LoosePlace`, since most of them are discarded.

    Attributes:
        corner: number of the token's corner.
        at: place of the corner, and direction of the edge that leaves it.
        polygon: see `LoosePlace`.
        over: see `LoosePlace`.
    """

    corner: int
    at: tuple[complex, complex]
    polygon: Polygon
    over: float


class LoosePlaces:
    """Finds loose places for one set of tokens."""

    def __init__(self, tokens: Tokens, tolerance: float) -> None:
        """Set the tokens, and the tolerance of the outline's sides, in units of the tokens."""
        self._tokens, self._tolerance = tokens, tolerance
        self._least = float(tokens.areas.min())
        self._bodies: Complex = np.array([corner.body for corner in tokens.corners])
        self._shape = np.array([corner.shape for corner in tokens.corners])
        self._angle = np.array([corner.angle for corner in tokens.corners])
        self._leaving = np.array([corner.leaving for corner in tokens.corners])

    def __call__(self, rest: Area, left: tuple[int, ...]) -> list[LoosePlace]:
        """The places at one corner of the rest: at the one with the fewest, but at least one."""
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
        """For each convex corner of a part, the tokens that may lie there."""
        found = list(convex_corners(part, self._tolerance))
        if len(found) > _CORNERS:  # a rugged outline: keep corners with long sides
            found = sorted(found, key=lambda one: -min(abs(one[3]), abs(one[4])))[:_CORNERS]
        if not found:
            return []
        point, along, angle, leaving, coming = np.array(found).T[..., None]
        slack = _TURN + 3.0 * self._tolerance / np.minimum(np.abs(leaving), np.abs(coming)).real
        fits = np.array(left)[self._shape] * (self._angle <= angle.real + slack) > 0
        # A negative length marks a side that may continue straight into the inside.
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
