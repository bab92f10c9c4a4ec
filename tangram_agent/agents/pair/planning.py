"""The planner: the actor proposes a pose for every pair, and the best proposal is played.

The critic values each proposal for its own piece. The best few are then valued for all pieces of
the target, because the value of an action is the sum of what it covers. The planner is one network
of fixed shapes, so that tangram-export can export it.

Legend: B environments, K tokens, V corners, N candidates of an environment (token, side and piece),
M = B * N pairs, row after row.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.agents.pair.covered import Covered
from tangram_agent.agents.pair.networks import Networks
from tangram_agent.agents.pair.pairs import PairGraph, Pairs
from tangram_agent.nets.networks import untraced
from tangram_tasks.place import Place

_SHORT_LIST = 8  # proposals of an environment that are valued for all pieces
# Weight of the value for the proposal's own piece, to decide between equal sums: a large triangle
# on three small pieces covers as much as on its own piece, but leaves a rest that nothing fits.
_OWN = 1e-4


@dataclass(frozen=True, eq=False)
class Scene:
    """Poses and coverage in B environments; a side is 1 where a token lies on its other side.

    Attributes:
        pose: (B, K, 3) of the tokens.
        flipped: (B, K) their sides.
        goal: (B, K, 3) of the target's pieces.
        goal_flipped: (B, K) their sides.
        covered: (B, K, K) share of piece j that tokens other than i cover.
        worth: (B, K) summed value of the areas that each token covers.
    """

    pose: Tensor
    flipped: Tensor
    goal: Tensor
    goal_flipped: Tensor
    covered: Tensor
    worth: Tensor


class Planner(nn.Module):
    """Chooses token, side and pose."""

    token: Tensor
    flip: Tensor
    piece: Tensor
    every: Tensor
    tokens: Tensor

    def __init__(self, networks: Networks, task: Place, reapply: int) -> None:
        super().__init__()
        self._networks, self._reapply, self._tokens = networks, reapply, task.layout.tokens
        self._covered = Covered(task.layout)
        self._graph = PairGraph(task.layout, task.sim.arena)
        turns_over = task.layout.chiral & task.sim.allow_flip
        sides = np.stack([np.ones_like(turns_over), turns_over], axis=-1)
        every = np.broadcast_to(sides[..., None], (*sides.shape, self._tokens))
        token, flip, piece = map(torch.from_numpy, np.nonzero(every))
        constants = {"token": token, "flip": flip, "piece": piece}
        constants |= {"every": torch.arange(len(token)), "tokens": torch.arange(self._tokens)}
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, corners: Tensor, placed: Tensor, goals: Tensor) -> tuple[Tensor, ...]:
        """Choose token, side and velocity; if all tokens are placed, an action of the first one.

        Args:
            corners: (B, V, 2) of the tokens, in double precision like `goals`.
            placed: (B, K) 1 where a token is placed.
            goals: (B, V, 2) of the target.

        Returns:
            (B,) index of the token, (B,) 1 where it is turned over, (B, 3) velocity in [-1, 1].

        Raises:
            ConfigError: see `untraced`.
        """
        untraced()
        scene, rows = self._scene(corners, goals), torch.arange(corners.shape[0])[:, None]
        which, allowed = self._candidates(placed)
        pairs = self._pairs(scene, rows, which, self.piece[which])
        pose = self._proposed(pairs)
        several = self.token.shape[0] > 1
        if several:
            value = self._valued(pairs, pose).view(which.shape)
            value = torch.where(allowed, value, -torch.inf)
            own, at = value.topk(min(_SHORT_LIST, value.shape[1]))
            which, pose = which.gather(1, at), pose.view(*value.shape, 3)[rows, at].flatten(0, 1)
            pairs = self._pairs(scene, rows, which, self.piece[which])
        for _ in range(self._reapply):
            pose = self._proposed(pairs.at(pose))
        velocity = self._graph.way(pairs, pose).clamp(-1.0, 1.0).view(*which.shape, 3)
        if several:
            at = (self._gained(scene, rows, which, pose) + _OWN * own).argmax(1, keepdim=True)
            which, velocity = which.gather(1, at), velocity[rows, at]
        return self.token[which[:, 0]], self.flip[which[:, 0]], velocity[:, 0]

    def _scene(self, corners: Tensor, goals: Tensor) -> Scene:
        """Poses and coverage; computed in double precision, given to networks in single."""
        lying, wanted = self._covered(corners), self._covered(goals)
        shares = self._covered.shares(lying, wanted)
        return Scene(*_pose(*lying), *_pose(*wanted), *(one.float() for one in shares))

    def _candidates(self, placed: Tensor) -> tuple[Tensor, Tensor]:
        """Indices (B, N) of candidates, and whether each of them may be played.

        Those of open tokens may be played, or those of the first token if none is open. While
        acting N is as small as possible. In an export N is fixed: shapes must depend on B alone.
        """
        is_open = placed == 0
        allowed = (is_open | ((self.tokens == 0) & ~is_open.any(1, keepdim=True)))[:, self.token]
        which = self.every.expand(allowed.shape)
        if not torch.compiler.is_exporting():
            which = (~allowed).int().argsort(dim=1, stable=True)[:, : int(allowed.sum(1).max())]
            allowed = allowed.gather(1, which)
        return which, allowed

    def _pairs(self, scene: Scene, rows: Tensor, which: Tensor, piece: Tensor) -> Pairs:
        """The pairs of candidates (B, N'), with pieces (B, N'), in a row."""
        token, flip = self.token[which], self.flip[which]
        parts = {
            "pose": scene.pose[rows, token],
            "flipped": (scene.flipped[rows, token] - flip).abs(),
            "token": token,
            "goal": scene.goal[rows, piece],
            "goal_flipped": scene.goal_flipped[rows, piece],
            "piece": piece,
            "covered": scene.covered[rows, token, piece],
        }
        return Pairs(**{name: part.flatten(0, 1) for name, part in parts.items()})

    def _proposed(self, pairs: Pairs) -> Tensor:
        """Poses (M, 3) that the actor gives to the tokens of pairs."""
        velocity, _ = self._networks.actor(pairs)
        return self._graph.moved(pairs, velocity).pose

    def _valued(self, pairs: Pairs, pose: Tensor) -> Tensor:
        """Values (M,) of moving the tokens of pairs to poses (M, 3)."""
        values: Tensor = self._networks.critic(pairs, self._graph.way(pairs, pose), pairs.at(pose))
        return values

    def _gained(self, scene: Scene, rows: Tensor, which: Tensor, pose: Tensor) -> Tensor:
        """Values (B, N') of candidates at poses for all pieces, minus the tokens' present worth."""
        count = self._tokens
        every = which.repeat_interleave(count, dim=1)
        piece = self.tokens.repeat(which.shape[1]).expand(every.shape)
        pairs = self._pairs(scene, rows, every, piece)
        values = self._valued(pairs, pose.repeat_interleave(count, dim=0))
        return values.view(*which.shape, count).sum(2) - scene.worth[rows, self.token[which]]


def _pose(centres: Tensor, turns: Tensor, flipped: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (B, K, 3) and sides (B, K) in single precision, from the result of `Covered`."""
    angles = torch.atan2(turns[..., 1].float(), turns[..., 0].float())
    return torch.cat([centres.float(), angles[..., None]], dim=-1), flipped.float()
