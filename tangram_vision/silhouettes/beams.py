"""A rough outline -> tokens that nearly fill it, by a beam: corners of it may be wrong, or lost.

Tokens lie where `tangram_vision.silhouettes.loose` has them, and nothing is searched through: the
states that are worth most are followed.

Legend: n states, S different shapes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tangram_core.arrays import Floats
from tangram_sim.geometry.areas import Area, valid
from tangram_sim.geometry.dissections import Budget, Laid, Tokens, less, without
from tangram_vision.silhouettes.loose import LoosePlaces

WIDTH = 12  # states of each depth that are followed
_SIZE = 0.25  # value of a token as large as the smallest one, where 1 is its area reaching out


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


class Beam:
    """Lays tokens in one outline after another, following the states of most worth.

    A state is worth the more, the larger the tokens that lie and the less they reach out.
    """

    def __init__(self, tokens: Tokens, width: int = WIDTH) -> None:
        """Follow so many states of each depth."""
        self._tokens, self._width = tokens, width
        self._least = float(tokens.areas.min())

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
        places, best = LoosePlaces(self._tokens, tolerance), list[State]()
        while kept:
            budget.taken += len(kept)
            states = [
                state
                for before in kept
                if not budget.spent()
                for state in self._next(before, places, tolerance)
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
        over = np.array([state.over for state in states])
        left = np.array([state.left for state in states]) @ self._tokens.areas
        return np.asarray(-(_SIZE * left + over) / self._least)

    def _next(self, state: State, places: LoosePlaces, tolerance: float) -> list[State]:
        """What may follow a state."""
        return [
            State(
                (*state.laid, place.laid),
                less(state.left, place.laid),
                without(state.rest, place.polygon, tolerance, self._tokens.unit),
                state.over + place.over,
            )
            for place in places(state.rest, state.left)
        ]
