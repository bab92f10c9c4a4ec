"""Batches of numpy -> what both losses see of them, tensors on the device.

Legend: M views, B scenes, K tokens.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from tangram_agent.agents.pair.pairs import Pairs
from tangram_agent.agents.scene.scenes import Scenes, next_token
from tangram_agent.networks import VELOCITY, View
from tangram_agent.relabelling import PairBatch
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions
from tangram_core.arrays import Bools, Floats, Ints
from tangram_sim.motion.actions import chosen_tokens

Array = npt.NDArray[Any]
Batch = Transitions | PairBatch


@dataclass(frozen=True, eq=False)
class Steps:
    """A batch as both losses see it.

    Attributes:
        view: where the action was taken.
        velocity: (M, 3) of the action, in the arena's axes.
        reward: (M,) what the critic learns, less what follows.
        done: (M,) 1 where nothing follows.
        start: where the actor is asked from: mostly the same view.
        follow: what the action came to.
            None where nothing follows on any of them.
        seen_after: that too where an afterstate critic is to see it as it was, else it sees the
            exact motion.
    """

    view: View
    velocity: Tensor
    reward: Tensor
    done: Tensor
    start: View
    follow: View | None
    seen_after: View | None = None


class Stepping:
    """Makes steps of batches."""

    def __init__(self, setup: Setup, device: torch.device) -> None:
        self._layout, self._tokens, self._device = setup.layout, setup.layout.tokens, device
        self._bootstraps = setup.bootstraps

    def __call__(self, batch: Batch) -> Steps:
        """A batch as tensors."""
        return self._of_pairs(batch) if isinstance(batch, PairBatch) else self._of_scenes(batch)

    def _of_scenes(self, batch: Transitions) -> Steps:
        state, placed = self._tensor(batch.state), self._tensor(batch.placed)
        goal, action = self._tensor(batch.goal), self._tensor(batch.action)
        taken = Scenes(
            state,
            placed,
            goal,
            self._index(chosen_tokens(batch.action.astype(np.float64), self._tokens)),
        )
        start = taken if self._tokens == 1 else Scenes(state, placed, goal, next_token(placed))
        following, flags = self._tensor(batch.next_state), self._tensor(batch.next_placed)
        return Steps(
            view=taken,
            velocity=action[:, -VELOCITY:],
            reward=self._tensor(batch.reward),
            done=self._tensor(batch.done),
            start=start,
            follow=self._if_any_follows(
                batch.done, Scenes(following, flags, goal, next_token(flags))
            ),
        )

    def _of_pairs(self, batch: PairBatch) -> Steps:
        after = self._pairs(batch, batch.after, batch.after_flipped)
        return Steps(
            view=self._pairs(batch, batch.before, batch.before_flipped),
            velocity=self._tensor(batch.velocity),
            reward=self._tensor(batch.reward),
            done=self._tensor(batch.done),
            start=self._pairs(batch, batch.start, batch.start_flipped),
            follow=self._if_any_follows(batch.done, after),
            seen_after=after,
        )

    def _if_any_follows(self, done: Array, follow: View) -> View | None:
        """What follows, where a target network is to be asked of it."""
        return follow if self._bootstraps and not done.all() else None

    def _pairs(self, batch: PairBatch, pose: Floats, flipped: Bools) -> Pairs:
        """The pairs (M,) with their tokens where they lay at some time."""
        return Pairs(
            pose=self._tensor(pose),
            flipped=self._tensor(flipped),
            token=self._index(batch.token),
            goal=self._tensor(batch.goal),
            goal_flipped=self._tensor(batch.goal_flipped),
            piece=self._index(batch.piece),
            covered=self._tensor(batch.covered),
        )

    def _tensor(self, column: Array) -> Tensor:
        return torch.from_numpy(np.asarray(column, np.float32)).to(self._device)

    def _index(self, column: Ints) -> Tensor:
        return torch.from_numpy(np.asarray(column, np.int64)).to(self._device)
