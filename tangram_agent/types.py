"""What travels between play and learning: small immutable tuples of arrays.

Legend: E episodes, T steps of an episode, B batch, K tokens, V corners of all tokens together,
A entries of an action (3 for one token: x, y and angular velocity; see `tangram_sim.actions`).
Goals and states are corners in the order of `tangram_sim.layout.Layout`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tangram_sim.arrays import Bools, Ints, Singles

Flags = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Episodes:
    """Whole episodes of equal length, as played: what a worker sends.

    Attributes:
        corners: (E, T + 1, V, 2) float32, tokens' corners before each step and after the last.
        placed: (E, T + 1, K) uint8, 1 where a token is placed.
        actions: (E, T, A) float32 in [-1, 1].
        rewards: (E, T) float32 of the goal that was played.
        goals: (E, V, 2) float32, target corners, or (E, G, 2) rows of its outline.
        seen: (E, T + 1, K) uint8, 1 where a token was found in the picture, or should have left
            that of several tokens; None where pictures are not what is observed.
        goals_seen: (E, K) uint8, the same of the target's pieces.
    """

    corners: Singles
    placed: Flags
    actions: Singles
    rewards: Singles
    goals: Singles
    seen: Flags | None = None
    goals_seen: Flags | None = None

    @property
    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Those that there are, by name."""
        return {name: array for name, array in vars(self).items() if array is not None}

    def learnable(self) -> "Episodes":
        """Those in which all tokens and pieces were seen at all times.

        To lose an episode of many actions for one token that left the picture would be worse than
        to learn from where it was told to go.
        """
        if self.seen is None or self.goals_seen is None:
            return self
        whole = self.seen.all(axis=(1, 2)) & self.goals_seen.all(axis=1)
        return Episodes(**{name: array[whole] for name, array in self.arrays.items()})

    @property
    def count(self) -> int:
        """E."""
        return len(self.corners)

    @property
    def steps(self) -> int:
        """T."""
        return int(self.actions.shape[1])

    @property
    def transitions(self) -> int:
        """E * T."""
        return self.count * self.steps


@dataclass(frozen=True, eq=False)
class Past:
    """What was seen and done in B episodes so far, T actions in each.

    Attributes:
        corners: (B, T, V, 2) of the tokens before each action.
        actions: (B, T, A).
        seen: (B, T + 1, K) which tokens were seen before each action, and now; None: all were.
    """

    corners: Singles
    actions: Singles
    seen: Flags | None = None


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
        """Those that there are, by name."""
        return {name: array for name, array in vars(self).items() if array is not None}

    @property
    def count(self) -> int:
        """B."""
        return len(self.state)


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights that workers play with.

    Attributes:
        version: number of the broadcast, rising within an epoch.
        tensors: name -> float32 array of the acting network, or of what of it travels.
    """

    version: int
    tensors: dict[str, Singles]
