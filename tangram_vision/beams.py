"""A rough outline -> tokens that nearly fill it, by a beam: corners of it may be wrong, or lost.

As in `tangram_sim.dissections` a token has a corner at a convex one of what is left, with an edge
along the side that leaves it. But it may reach out of what is left, no part need have the area of
tokens, and nothing is searched through: the states that are worth most are followed.

Legend: n states, S different shapes.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import shapely
from shapely import Polygon

from tangram_sim.areas import Area, valid
from tangram_sim.arrays import Complex, Floats
from tangram_sim.dissections import (
    Budget,
    Laid,
    Tokens,
    convex_corners,
    laid_at,
    less,
    parts_of,
    without,
)

# (what is left to fill, and how many tokens of each shape, of n states) -> (n,) how surely these
# fill that, as logits.
Values: TypeAlias = Callable[[Sequence[Area], Sequence[tuple[int, ...]]], Floats]

_OVER = 0.5  # of the smallest token's area that a token may reach out of what is left
_TURN = np.radians(1.0)  # that a corner's angle may be wrong, and more where its sides are short
_CORNERS = 40  # of a part that are looked at: tans leave no more
_SIZE = 0.25  # value of a token as large as the smallest one
_UNSEEN = -20.0  # value of what is not judged


class State(NamedTuple):
    """Tokens that lie, and what they leave.

    Attributes:
        laid: the tokens.
        left: how many are left of each shape.
        rest: what is left to fill.
        over: area by which the tokens reach out of what there was to fill.
    """

    laid: tuple[Laid, ...]
    left: tuple[int, ...]
    rest: Area
    over: float


class _Place(NamedTuple):
    """Where a token may lie.

    Attributes:
        corner: number of the corner that it has there.
        at: where, and the direction of the edge that leaves it.
        polygon: the token.
        over: how far it reaches out.
    """

    corner: int
    at: tuple[complex, complex]
    polygon: Polygon
    over: float


class Beam:
    """Lays tokens in one outline after another, the states of most worth at a time."""

    def __init__(self, tokens: Tokens, width: int, values: Values | None = None) -> None:
        """Follow so many states.

        Args:
            tokens: that are laid.
            width: states of each depth that are followed.
            values: what states are worth; None: the more, the larger the tokens that lie.
        """
        self._tokens, self._width, self._values = tokens, width, values
        self._least = float(tokens.areas.min())
        self._bodies: Complex = np.array([corner.body for corner in tokens.corners])
        self._shape = np.array([corner.shape for corner in tokens.corners])
        self._angle = np.array([corner.angle for corner in tokens.corners])
        self._leaving = np.array([corner.leaving for corner in tokens.corners])

    def run(
        self, outline: Area, left: tuple[int, ...], tolerance: float, budget: Budget
    ) -> list[State]:
        """How tokens were laid, not always all of them; what covers most by least comes first.

        Args:
            outline: in the units of the tokens.
            left: how many tokens of each shape there are to lay.
            tolerance: how far its sides may be from where they should be.
            budget: what it may cost.
        """
        kept = [State((), left, valid(outline), 0.0)]
        best: list[State] = []
        while kept:
            budget.taken += len(kept)
            states = [
                state
                for before in kept
                if not budget.spent()
                for state in self._next(before, tolerance)
            ]
            order = np.argsort(-self._worth(states), kind="stable")[: self._width]
            kept = [states[i] for i in order.tolist()]
            best = sorted([*best, *kept], key=self._uncovered)[: self._width]
        return best

    def _uncovered(self, state: State) -> float:
        return float(self._tokens.areas @ state.left) + state.over

    def _worth(self, states: Sequence[State]) -> Floats:
        if not states:
            return np.zeros(0)
        over = np.array([state.over for state in states]) / self._least
        if self._values is None:
            left: Floats = np.array([state.left for state in states]) @ self._tokens.areas
            return np.asarray(-_SIZE * left / self._least - over)
        rests, left_of = [state.rest for state in states], [state.left for state in states]
        return np.maximum(self._values(rests, left_of), _UNSEEN) - over

    def _next(self, state: State, tolerance: float) -> list[State]:
        """What may lie at the corner of what is left where least may, but something."""
        least: list[_Place] = []
        for part in parts_of(state.rest, self._least):
            for places in self._places(part, state.left, tolerance):
                if places and (not least or len(places) < len(least)):
                    least = places
        return [
            State(
                (*state.laid, one := laid_at(self._tokens.corners[place.corner], *place.at)),
                less(state.left, one),
                without(state.rest, place.polygon, tolerance, self._tokens.unit),
                state.over + place.over,
            )
            for place in least
        ]

    def _places(self, part: Polygon, left: tuple[int, ...], tolerance: float) -> list[list[_Place]]:
        """For each convex corner of a part what may lie there."""
        found = list(convex_corners(part, tolerance))
        if len(found) > _CORNERS:  # of a rugged outline those with the longest sides
            found = sorted(found, key=lambda one: -min(abs(one[3]), abs(one[4])))[:_CORNERS]
        if not found:
            return []
        point, along, angle, leaving, coming = np.array(found).T[..., None]
        slack = _TURN + 3.0 * tolerance / np.minimum(np.abs(leaving), np.abs(coming)).real
        fits = np.array(left)[self._shape] * (self._angle <= angle.real + slack) > 0
        # A negative length is that of a side that may go on straight inside.
        fits &= (leaving.real < 0.0) | (leaving.real >= self._leaving - 2.0 * tolerance)
        shapely.prepare(part)
        middle = point + along * self._bodies.mean(axis=1)
        fits &= shapely.contains_xy(part, middle.real, middle.imag)
        rows, corners = np.nonzero(fits)
        z = point[rows] + along[rows] * self._bodies[corners]
        polygons = shapely.polygons(np.stack([z.real, z.imag], axis=-1))
        over = shapely.area(polygons) - shapely.area(shapely.intersection(part, polygons))
        places: list[list[_Place]] = [[] for _ in found]
        for i in np.flatnonzero(over < _OVER * self._least).tolist():
            row, corner = int(rows[i]), int(corners[i])
            places[row].append(_Place(corner, found[row][:2], polygons[i], float(over[i])))
        return places
