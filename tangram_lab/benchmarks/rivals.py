"""What general optimisation fills of exact outlines, with the time that the search has.

Beside our own annealing and genetic algorithm stand those of scipy, as they come, on the same
states: places anywhere, ways to lie by whole numbers.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import Bounds, differential_evolution, dual_annealing

from tangram_lab.benchmarks.annealing import annealed
from tangram_lab.benchmarks.covering import Attempt
from tangram_lab.benchmarks.genetic import bred
from tangram_sim.arrays import Floats
from tangram_vision.silhouettes import Filled

Rival: TypeAlias = "Callable[[Attempt, np.random.Generator], Filled]"


class _OverError(Exception):
    """An attempt is over: scipy's ways are left so, since not all of them ask."""


def evolved(attempt: Attempt, rng: np.random.Generator) -> Filled:
    """By scipy's differential evolution, begun anew where all its states are alike."""
    whole = np.tile([False, False, True], attempt.board.layout.tokens)
    try:
        while True:
            differential_evolution(
                _uncovered(attempt),
                _bounds(attempt),
                integrality=whole,
                vectorized=True,
                updating="deferred",
                polish=False,  # by gradients, of which a count of points has none
                rng=rng,
            )
    except _OverError:
        return attempt.result()


def dually_annealed(attempt: Attempt, rng: np.random.Generator) -> Filled:
    """By scipy's dual annealing."""
    try:
        while True:
            # No local search, which goes by gradients, too.
            dual_annealing(_uncovered(attempt), _bounds(attempt), no_local_search=True, rng=rng)
    except _OverError:
        return attempt.result()


RIVALS: Mapping[str, Rival] = MappingProxyType(
    {
        "simulated annealing": annealed,
        "genetic algorithm": bred,
        "scipy, differential evolution": evolved,
        "scipy, dual annealing": dually_annealed,
    }
)


def _bounds(attempt: Attempt) -> Bounds:
    """Of x, y and the way to lie of each token."""
    board = attempt.board
    x, y = board.points.real, board.points.imag
    low, high = (x.min(), y.min(), -0.5), (x.max(), y.max(), board.lies - 0.5)
    return Bounds(np.tile(low, board.layout.tokens), np.tile(high, board.layout.tokens))


def _uncovered(attempt: Attempt) -> Callable[[Floats], Any]:
    """What is made least: of one state (3K,), or of several (3K, B) at once."""
    board = attempt.board

    def share(x: Floats) -> Any:
        each = np.atleast_2d(x.T).reshape(-1, board.layout.tokens, 3)
        lie = np.clip(np.round(each[..., 2]), 0, board.lies - 1).astype(np.int64)
        states = board.states(each[..., 0] + 1j * each[..., 1], lie)
        attempt.evaluations += len(each)
        if attempt.look(states):
            raise _OverError
        left = states.uncovered()
        return left if x.ndim > 1 else float(left[0])

    return share
