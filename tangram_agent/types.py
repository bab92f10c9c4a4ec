"""What travels between play and learning: small immutable tuples of arrays.

Legend: E episodes, T steps of an episode, B batch, K tokens, V corners of all tokens together,
A entries of an action (3 for one token: x, y and angular velocity; see `tangram_sim.actions`).
Goals and states are corners in the order of `tangram_sim.layout.Layout`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tangram_sim.actions import chosen_tokens
from tangram_sim.arrays import Singles
from tangram_sim.sight import SURE

Flags = npt.NDArray[np.uint8]
AWAY = -1.0  # confidence of a token that should have left the picture


@dataclass(frozen=True, eq=False)
class Episodes:
    """Whole episodes of equal length, as played: what a worker sends.

    Attributes:
        corners: (E, T + 1, V, 2) float32, tokens' corners before each step and after the last.
        placed: (E, T + 1, K) uint8, 1 where a token is placed.
        actions: (E, T, A) float32 in [-1, 1].
        rewards: (E, T) float32 of the goal that was played.
        goals: (E, V, 2) float32, target corners, or (E, G, 2) rows of its outline.
        confidence: (E, T + 1, K) float32 in [0, 1], how surely tokens were seen in a picture, see
            `tangram_sim.sight.Look`, or `AWAY`; None where pictures are not what is observed.
        goals_confidence: (E, K) float32 in [0, 1], the same of the target's pieces; 1 of outlines.
        achieved: (E, G, 2) rows of the outline of what tokens came to cover, as it was traced in
            the camera's picture of it; None where targets are not traced.
    """

    corners: Singles
    placed: Flags
    actions: Singles
    rewards: Singles
    goals: Singles
    confidence: Singles | None = None
    goals_confidence: Singles | None = None
    achieved: Singles | None = None

    @property
    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Those that there are, by name."""
        return {name: array for name, array in vars(self).items() if array is not None}

    def learnable(self, doubts: bool) -> "Episodes":
        """Those that show what their actions did; of several tokens some may have left the picture.

        Where those lie is only known by what they were told, but to lose an episode of many actions
        for one that left is worse.

        Args:
            doubts: whether the agent knows how surely it sees a token. Else all tokens are to be
                surely seen at all times; with it those that an action named, after that.
        """
        if self.confidence is None or self.goals_confidence is None:
            return self
        several = self.confidence.shape[2] > 1
        gone = (self.confidence < SURE) & ((self.confidence != AWAY) | (not several))
        if doubts:
            named = chosen_tokens(
                self.actions.reshape(self.transitions, self.actions.shape[2]).astype(np.float64),
                gone.shape[2],
            )
            index = named.reshape(self.count, self.steps, 1)
            gone = np.take_along_axis(gone[:, 1:], index, axis=2)
        whole = ~(gone.any(axis=(1, 2)) | (self.goals_confidence < SURE).any(axis=1))
        return Episodes(
            corners=self.corners[whole],
            placed=self.placed[whole],
            actions=self.actions[whole],
            rewards=self.rewards[whole],
            goals=self.goals[whole],
            confidence=self.confidence[whole],
            achieved=None if self.achieved is None else self.achieved[whole],
        )

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
        confidence: (B, T + 1, K) how surely tokens were seen before each action, and now; None:
            all were.
        placed: (B, K) which are placed now, where some are not surely seen.
    """

    corners: Singles
    actions: Singles
    confidence: Singles | None = None
    placed: Flags | None = None


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
        confidence, next_confidence: (B, K) float32, how surely tokens were seen, where pictures are
            what is observed.
    """

    state: Singles
    placed: Flags
    action: Singles
    reward: Singles
    next_state: Singles
    next_placed: Flags
    done: Flags
    goal: Singles
    confidence: Singles | None = None
    next_confidence: Singles | None = None

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
