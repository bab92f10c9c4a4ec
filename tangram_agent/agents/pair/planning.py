"""Choosing among proposals: a pose for every pair of a token and a piece, and the best one played.

The critic values each proposal for its own piece; the best few are then valued for all pieces of
the target, as an action is worth the sum of what it covers.

Legend: B environments, K tokens, V corners, M candidates (pairs of all environments, row after
row).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tangram_agent.agents.pair.coverage import covered_share, covering, worths
from tangram_agent.agents.pair.networks import Networks
from tangram_agent.agents.pair.pairs import PairGraph, Pairs
from tangram_agent.base.acting import tensor
from tangram_agent.base.types import Choice
from tangram_core.arrays import Bools, Floats
from tangram_tasks.place import Place

_SHORT_LIST = 8  # proposals of an environment that are valued for all pieces


@dataclass(frozen=True, eq=False)
class Candidates:
    """M actions that may be played: each takes a token to a piece of the target.

    Attributes:
        row: (M,) environment, in order.
        token: (M,) which token.
        flip: (M,) 1 where it is turned over.
        piece: (M,) which piece it is meant for.
    """

    row: Tensor
    token: Tensor
    flip: Tensor
    piece: Tensor

    def at(self, index: Tensor) -> "Candidates":
        """The candidates at these indices."""
        return Candidates(*(part[index] for part in vars(self).values()))

    def best(self, value: Tensor, most: int) -> Tensor:
        """Indices (M',) of the best of each row by a value (M,), row after row."""
        # Values row by row, (B, L), filled up with -inf, and where each row begins, (B,).
        counts = torch.bincount(self.row)
        first = counts.cumsum(0) - counts
        table = torch.full((len(counts), int(counts.max())), -torch.inf)
        table[self.row, torch.arange(len(self.row)) - first[self.row]] = value
        best = table.topk(min(most, table.shape[1]), dim=1)
        return (best.indices + first[:, None])[best.values > -torch.inf]


@dataclass(frozen=True, eq=False)
class Scene:
    """B environments as tensors; sides are 1 where a token lies on its other one.

    Attributes:
        pose: (B, K, 3) of the tokens.
        flipped: (B, K) their sides.
        goal: (B, K, 3) of the target's pieces.
        goal_flipped: (B, K) their sides.
        covered: (B, K, K) share of the second, a piece, that tokens other than the first cover.
        worth: (B, K) sum of the values of what each token covers.
    """

    pose: Tensor
    flipped: Tensor
    goal: Tensor
    goal_flipped: Tensor
    covered: Tensor
    worth: Tensor

    def pairs(self, c: Candidates) -> Pairs:
        """The pairs (M,) of candidates; a token that is turned over has changed its side."""
        return Pairs(
            pose=self.pose[c.row, c.token],
            flipped=(self.flipped[c.row, c.token] - c.flip).abs(),
            token=c.token,
            goal=self.goal[c.row, c.piece],
            goal_flipped=self.goal_flipped[c.row, c.piece],
            piece=c.piece,
            covered=self.covered[c.row, c.token, c.piece],
        )

    def leaves_no_choice(self, candidates: Candidates) -> bool:
        """Whether each environment has one candidate, so that nobody need say which is better."""
        return len(candidates.row) == len(self.pose)


class Planner:
    """Chooses token, side and pose."""

    def __init__(self, networks: Networks, task: Place, reapply: int) -> None:
        self._networks, self._layout, self._reapply = networks, task.layout, reapply
        self._graph = PairGraph(task.layout, task.sim.arena)
        self._turns_over = task.layout.chiral & task.sim.allow_flip

    def choose(self, corners: Floats, placed: Bools, goals: Floats) -> Choice:
        """What to play; where all tokens are placed, some action of the first one.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) which tokens are placed.
            goals: (B, V, 2) of the target.
        """
        is_open: Bools = ~np.asarray(placed, np.bool_)
        is_open[~is_open.any(axis=1), 0] = True
        with torch.no_grad():
            scene = self._scene(corners, goals)
            candidates, pose = self._short_list(scene, is_open)
            velocity = self._graph.way(scene.pairs(candidates), pose).clamp(-1.0, 1.0)
            best = self._best(scene, candidates, pose)
        chosen = candidates.at(best)
        return Choice(chosen.token.numpy(), chosen.flip.numpy() > 0.5, velocity[best].numpy())

    def _scene(self, corners: Floats, goals: Floats) -> Scene:
        layout = self._layout
        covered = covering(corners, goals, layout)
        return Scene(
            pose=tensor(layout.poses(corners)),
            flipped=tensor(layout.flipped(corners)),
            goal=tensor(layout.poses(goals)),
            goal_flipped=tensor(layout.flipped(goals)),
            covered=tensor(covered_share(covered, layout)),
            worth=tensor(worths(covered, layout)),
        )

    def _short_list(self, scene: Scene, is_open: Bools) -> tuple[Candidates, Tensor]:
        """The best few of all pairs that may be played, by their own piece's value, and poses.

        The actor is applied again to its own proposals as often as it is configured.
        """
        sides = np.stack([is_open, is_open & self._turns_over], axis=-1)
        every = np.broadcast_to(sides[..., None], (*sides.shape, self._layout.tokens))
        row, token, flip, piece = map(torch.from_numpy, np.nonzero(every))
        candidates = Candidates(row, token, flip.float(), piece)
        pairs = scene.pairs(candidates)
        pose = self._proposed(pairs)
        if not scene.leaves_no_choice(candidates):
            best = candidates.best(self._valued(pairs, pose), _SHORT_LIST)
            candidates, pose = candidates.at(best), pose[best]
            pairs = scene.pairs(candidates)
        for _ in range(self._reapply):
            pose = self._proposed(pairs.at(pose))
        return candidates, pose

    def _proposed(self, pairs: Pairs) -> Tensor:
        """Poses (M, 3) that the actor gives to the tokens of pairs."""
        velocity, _ = self._networks.actor(pairs)
        return self._graph.moved(pairs, velocity).pose

    def _valued(self, pairs: Pairs, pose: Tensor) -> Tensor:
        """Values (M,) of moving the tokens of pairs to poses (M, 3)."""
        values: Tensor = self._networks.critic(pairs, self._graph.way(pairs, pose), pairs.at(pose))
        return values

    def _best(self, scene: Scene, candidates: Candidates, pose: Tensor) -> Tensor:
        """Index (B,) of the best candidate of each row, valued for all pieces of the target."""
        if scene.leaves_no_choice(candidates):
            return torch.arange(len(pose))
        count = self._layout.tokens
        every = candidates.at(torch.arange(len(pose)).repeat_interleave(count))
        pairs = scene.pairs(replace(every, piece=torch.arange(count).repeat(len(pose))))
        values = self._valued(pairs, pose.repeat_interleave(count, dim=0))
        # What a token covers already it gives up.
        given_up = scene.worth[candidates.row, candidates.token]
        return candidates.best(values.view(-1, count).sum(dim=1) - given_up, 1)
