"""Nearly fill a rough outline by beam search; corners of the outline may be wrong or missing.

`tangram_vision.silhouettes.loose` proposes places of tokens. The search is not complete: at each
depth only the best states are followed.

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
_SIZE = 0.25  # value of an area that is laid; the same area outside of the outline costs 1


class State(NamedTuple):
    """Tokens that were laid, and the rest of the outline.

    Attributes:
        laid: the tokens that were laid.
        left: number of tokens left of each shape.
        rest: area that is left to fill.
        over: area of the tokens that lies outside of the area to fill.
    """

    laid: tuple[Laid, ...]
    left: tuple[int, ...]
    rest: Area
    over: float


class Beam:
    """Beam search that lays tokens in outlines.

    A state ranks higher the larger its laid tokens are, and the less they reach out.
    """

    def __init__(self, tokens: Tokens, width: int = WIDTH) -> None:
        """Follow the `width` best states of each depth."""
        self._tokens, self._width = tokens, width
        self._least = float(tokens.areas.min())

    def run(
        self, outline: Area, left: tuple[int, ...], tolerance: float, budget: Budget
    ) -> list[State]:
        """The best states that were found; not all of them lay every token.

        Args:
            outline: area to fill, in the units of the tokens.
            left: number of tokens of each shape to lay.
            tolerance: distance of the outline's sides from their true places, at most.
            budget: limit of the search.
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
        """The states with one token more."""
        return [
            State(
                (*state.laid, place.laid),
                less(state.left, place.laid.shape),
                without(state.rest, place.polygon, tolerance, self._tokens.unit),
                state.over + place.over,
            )
            for place in places(state.rest, state.left)
        ]
