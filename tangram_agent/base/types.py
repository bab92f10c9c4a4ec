"""What travels between play and learning: small immutable tuples of arrays.

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
    """What B environments play.

    Attributes:
        token: (B,) which token.
        flip: (B,) whether it is turned over.
        velocity: (B, 3) in [-1, 1], the command that takes it where it is to go.
    """

    token: Ints
    flip: Bools
    velocity: Singles


@dataclass(frozen=True, eq=False)
class Transitions:
    """A flat batch of (s, a, r, s', d, g).

    Attributes:
        state, next_state: (B, V, 2) float32 token corners.
        placed, next_placed: (B, K) uint8.
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
        """All of them, by name."""
        return dict(vars(self))

    @property
    def count(self) -> int:
        """B."""
        return len(self.state)
