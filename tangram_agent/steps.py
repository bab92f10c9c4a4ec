"""Batches of numpy -> what both losses see of them, tensors on the device.

Legend: M views, B scenes, K tokens.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from tangram_agent.networks import VELOCITY, View
from tangram_agent.pairs import Pairs
from tangram_agent.relabelling import PairBatch, SceneBatch
from tangram_agent.scenes import Scenes, next_token
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions
from tangram_sim.actions import chosen_tokens
from tangram_sim.arrays import Bools, Floats, Ints

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
        scenes: all pairs of whole scenes, where the critic learns their reward.
    """

    view: View
    velocity: Tensor
    reward: Tensor
    done: Tensor
    start: View
    follow: View | None
    seen_after: View | None = None
    scenes: "Sums | None" = None


@dataclass(frozen=True, eq=False)
class Sums:
    """Rewards of B scenes as sums over all pairs of a token and a piece.

    Attributes:
        pairs: (B K K) of all scenes.
        weights: (K K) of the pairs of one.
        reward: (B,) that the environment returned.
    """

    pairs: Pairs
    weights: Tensor
    reward: Tensor


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
        sure = self._tensor(batch.confidence)
        after = self._pairs(batch, batch.after, batch.after_flipped, sure)
        start = self._tensor(batch.start_confidence)
        return Steps(
            view=self._pairs(batch, batch.before, batch.before_flipped, sure),
            velocity=self._tensor(batch.velocity),
            reward=self._tensor(batch.reward),
            done=self._tensor(batch.done),
            start=self._pairs(batch, batch.start, batch.start_flipped, start),
            follow=self._if_any_follows(batch.done, after),
            seen_after=after,
            scenes=self._sums(batch) if isinstance(batch, SceneBatch) else None,
        )

    def _if_any_follows(self, done: Array, follow: View) -> View | None:
        """What follows, where a target network is to be asked of it."""
        return follow if self._bootstraps and not done.all() else None

    def _pairs(
        self, batch: PairBatch, pose: Floats, flipped: Bools, confidence: Tensor | None = None
    ) -> Pairs:
        """The pairs (M,) with their tokens where they lay at some time."""
        return Pairs(
            pose=self._tensor(pose),
            flipped=self._tensor(flipped),
            token=self._index(batch.token),
            goal=self._tensor(batch.goal),
            goal_flipped=self._tensor(batch.goal_flipped),
            piece=self._index(batch.piece),
            covered=self._tensor(batch.covered),
            confidence=confidence,
        )

    def _sums(self, batch: SceneBatch) -> Sums:
        count, tokens = batch.poses.shape[:2]
        token, piece = (part.reshape(-1) for part in np.indices((tokens, tokens)))
        pairs = Pairs(
            pose=self._tensor(batch.poses[:, token].reshape(-1, 3)),
            flipped=self._tensor(batch.flips[:, token].reshape(-1)),
            token=self._index(np.tile(token, count)),
            goal=self._tensor(batch.goals[:, piece].reshape(-1, 3)),
            goal_flipped=self._tensor(batch.goal_flips[:, piece].reshape(-1)),
            piece=self._index(np.tile(piece, count)),
            covered=torch.zeros(count * tokens * tokens, device=self._device),
        )
        areas = self._layout.areas
        weights = self._tensor(np.maximum(areas[token], areas[piece]) / areas.sum())
        return Sums(pairs, weights, self._tensor(batch.returned))

    def _tensor(self, column: Array) -> Tensor:
        return torch.from_numpy(np.asarray(column, np.float32)).to(self._device)

    def _index(self, column: Ints) -> Tensor:
        return torch.from_numpy(np.asarray(column, np.int64)).to(self._device)
