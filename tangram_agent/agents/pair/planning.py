"""Choosing among proposals: a pose for every pair of a token and a piece, and the best one played.

The critic values each proposal for its own piece; the best few are then valued for all pieces of
the target, as an action is worth the sum of what it covers. All of it is one network of fixed
shapes, so that tangram-export can write it down.

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
# Of two that cover as much, the one that fills its own piece: a large triangle on three small
# pieces is worth as much as one on its own, and leaves what nothing fits.
_OWN = 1e-4


@dataclass(frozen=True, eq=False)
class Scene:
    """B environments; sides are 1 where a token lies on its other one.

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
        """What to play; where all tokens are placed, some action of the first one.

        Args:
            corners: (B, V, 2) of the tokens, in double precision as goals are.
            placed: (B, K) 1 where a token is placed.
            goals: (B, V, 2) of the target.

        Returns:
            (B,) which token, (B,) 1 where it is turned over, and (B, 3) its velocity in [-1, 1].

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
        """Poses and what is covered; geometry is in double precision, what networks see is not."""
        lying, wanted = self._covered(corners), self._covered(goals)
        shares = self._covered.shares(lying, wanted)
        return Scene(*_pose(*lying), *_pose(*wanted), *(one.float() for one in shares))

    def _candidates(self, placed: Tensor) -> tuple[Tensor, Tensor]:
        """Which candidates (B, N) there are, and whether they may be played.

        Those whose token is open, the first token's where none is. In play only as many as a row of
        them needs; where it is written down shapes hang on B alone.
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
        """(B, N') what candidates in poses are worth for all pieces, less what they give up."""
        count = self._tokens
        every = which.repeat_interleave(count, dim=1)
        piece = self.tokens.repeat(which.shape[1]).expand(every.shape)
        pairs = self._pairs(scene, rows, every, piece)
        values = self._valued(pairs, pose.repeat_interleave(count, dim=0))
        return values.view(*which.shape, count).sum(2) - scene.worth[rows, self.token[which]]


def _pose(centres: Tensor, turns: Tensor, flipped: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (B, K, 3) and sides (B, K) of what `Covered` says, in single precision."""
    angles = torch.atan2(turns[..., 1].float(), turns[..., 0].float())
    return torch.cat([centres.float(), angles[..., None]], dim=-1), flipped.float()
