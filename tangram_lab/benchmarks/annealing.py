"""A rival of the search: simulated annealing of an outline's tokens.

Several states cool beside each other. In each step one token of each is taken up and laid where one
of some tries says, drawn by the Boltzmann distribution of what would then be uncovered (a heat
bath): to stay is one of them. A round begins anew where it ended without a result.
"""

from dataclasses import dataclass

import numpy as np

from tangram_lab.benchmarks.covering import Attempt
from tangram_vision.silhouettes import Filled

_LOOK = 16  # steps


@dataclass(frozen=True)
class Cooling:
    """How it cools.

    Attributes:
        states: B.
        tries: M of a token.
        steps: of a round.
        hot, cold: temperatures at its two ends, shares of the outline. The smallest tan is 0.06 of
            it, and there are some thousand tries for each.
    """

    states: int = 8
    tries: int = 32
    steps: int = 2_000
    hot: float = 0.015
    cold: float = 0.003


def annealed(attempt: Attempt, rng: np.random.Generator, way: Cooling = Cooling()) -> Filled:
    """The best filling that was found, as soon as it counts as one."""
    board, shape = attempt.board, (way.states, way.tries)
    while True:
        states = board.random(way.states, rng)
        for step in range(way.steps):
            heat = way.hot * (way.cold / way.hot) ** (step / way.steps)
            tokens = rng.integers(board.layout.tokens, size=way.states)
            tries = board.tries(states, tokens, way.tries, rng)
            # With Gumbel's noise the largest is a draw from Boltzmann's distribution.
            states.lay(tokens, tries, (tries.gain / heat + rng.gumbel(size=shape)).argmax(axis=1))
            attempt.evaluations += tries.gain.size
            if step % _LOOK == 0 and attempt.look(states):
                return attempt.result()
