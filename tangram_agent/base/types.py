"""Data classes of arrays that play and learning exchange.

Legend: E episodes, T steps of an episode, B batch, K tokens, V corners of all tokens together,
A entries of an action (3 for one token: x, y and angular velocity; `tangram_sim.motion.actions`).
Goals and states are corners in the order of `tangram_sim.geometry.layout.Layout`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tangram_core.arrays import Bools, Ints, Singles

Flags = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Choice:
    """Chosen moves in B environments.

    Attributes:
        token: (B,) index of the token that moves.
        flip: (B,) whether the token is turned over.
        velocity: (B, 3) clipped to [-1, 1], moves the token towards its chosen pose.
    """

    token: Ints
    flip: Bools
    velocity: Singles


@dataclass(frozen=True, eq=False)
class Transitions:
    """A flat batch of transitions (s, a, r, s', d, g).

    Attributes:
        state, next_state: (B, V, 2) float32 token corners.
        placed, next_placed: (B, K) uint8, 1 where a token is placed.
        action: (B, A) float32.
        reward: (B,) float32.
        done: (B,) uint8, 1 where next_state is terminal; a time limit is not.
        goal: (B, V, 2) float32 target corners.
    """

    state: Singles
    placed: Flags
    action: Singles
    reward: Singles
    next_state: Singles
    next_placed: Flags
    done: Flags
    goal: Singles

    @property
    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays, by name."""
        return dict(vars(self))

    @property
    def count(self) -> int:
        """B, the number of transitions."""
        return len(self.state)
