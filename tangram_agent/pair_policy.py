"""Acting with several tokens: a pose proposed for every pair, and the best of them played.

The critic values each proposal for its own piece; the best few are then valued for all pieces of
the target, as an action is worth the sum of what it covers.

Legend: B environments, K tokens, V corners, M candidates (pairs of all environments).
"""

import zlib
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tangram_agent.config import AgentConfig
from tangram_agent.pair_batch import covered_share
from tangram_agent.pair_networks import PairNetworks
from tangram_agent.pairs import Pairs
from tangram_sim.arrays import Bools, Floats, Ints, Singles
from tangram_sim.layout import Layout

_Candidates = tuple[Tensor, Tensor, Tensor, Tensor]  # row, token, flip and piece, each (M,)

_SHORT_LIST = 8  # proposals of an environment that are valued for all pieces


@dataclass(frozen=True, eq=False)
class Choice:
    """What B environments play.

    Attributes:
        token: (B,) which token.
        flip: (B,) whether it is turned over.
        pose: (B, 3) where it goes.
        value: (B,) what the critic expects: newly covered area over that of the larger piece.
    """

    token: Ints
    flip: Bools
    pose: Floats
    value: Singles


@dataclass(frozen=True, eq=False)
class _Scene:
    """B environments as tensors: poses (B, K, 3), sides (B, K), covered shares (B, K)."""

    pose: Tensor
    flipped: Tensor
    goal: Tensor
    goal_flipped: Tensor
    covered: Tensor

    def pairs(self, row: Tensor, token: Tensor, flip: Tensor, piece: Tensor) -> Pairs:
        """The pairs (M,) of these rows, tokens and pieces; a flipped token has changed its side."""
        side = self.flipped[row, token]
        return Pairs(
            pose=self.pose[row, token],
            flipped=(side - flip).abs(),
            token=token,
            goal=self.goal[row, piece],
            goal_flipped=self.goal_flipped[row, piece],
            piece=piece,
            covered=self.covered[row, piece],
        )


class PairChooser:
    """Chooses token, side and pose."""

    def __init__(
        self, networks: PairNetworks, layout: Layout, agent: AgentConfig, allow_flip: bool
    ) -> None:
        self._networks, self._layout, self._agent = networks, layout, agent
        self._turns_over = layout.chiral & allow_flip

    def choose(self, corners: Floats, placed: Bools, goals: Floats, refine: bool = True) -> Choice:
        """What to play, where every environment still has a token to place.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) which tokens are placed; where all are, the first one is named.
            goals: (B, V, 2) of the target.
            refine: take the gradient steps that the agent is configured for.
        """
        scene = self._scene(corners, placed, goals)
        with torch.no_grad():
            candidates = self._candidates(self._open(placed, goals))
            proposed = self._propose(scene, candidates)
            best, value = self._best(scene, candidates, proposed)
        row, token, flip = candidates[0][best], candidates[1][best], candidates[2][best]
        pose = proposed[best]
        if refine and self._agent.refine_steps:
            pose, value = self._refined(scene, row, token, flip, pose)
        return Choice(
            token.numpy(), flip.numpy() > 0.5, pose.numpy().astype(np.float64), value.numpy()
        )

    def _scene(self, corners: Floats, placed: Bools, goals: Floats) -> _Scene:
        layout, count = self._layout, self._layout.tokens
        rows, pieces = np.divmod(np.arange(len(corners) * count), count)
        covered = covered_share(corners[rows], placed[rows], goals[rows], pieces, layout)
        return _Scene(
            _tensor(layout.poses(corners)),
            _tensor(layout.flipped(corners)),
            _tensor(layout.poses(goals)),
            _tensor(layout.flipped(goals)),
            _tensor(covered.reshape(-1, count)),
        )

    def _open(self, placed: Bools, goals: Floats) -> Bools:
        """(B, K) tokens that may be next, at least one in each row."""
        is_open: Bools = ~np.asarray(placed, np.bool_)
        is_open[~is_open.any(axis=1), 0] = True
        if self._agent.order == "learned":
            return is_open
        # The first one that is left, by rank.
        rank = np.where(is_open, _ranks(self._agent.order, self._layout, goals), np.inf)
        return np.asarray(np.arange(rank.shape[1]) == rank.argmin(axis=1)[:, None])

    def _candidates(self, is_open: Bools) -> _Candidates:
        """Row, token, flip and piece (M,) of every pair that may be played, row after row."""
        sides = np.stack([is_open, is_open & self._turns_over], axis=-1)
        every = np.broadcast_to(sides[..., None], (*sides.shape, self._layout.tokens))
        row, token, flip, piece = map(torch.from_numpy, np.nonzero(every))
        return row, token, flip.float(), piece

    def _propose(self, scene: _Scene, candidates: _Candidates) -> Tensor:
        """Poses (M, 3)."""
        pairs = scene.pairs(*candidates)
        pose: Tensor = self._networks.actor(pairs)[0]
        for _ in range(self._agent.reapply):
            pose = self._networks.actor(pairs.at(pose))[0]
        return pose

    def _best(
        self, scene: _Scene, candidates: _Candidates, proposed: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Index (B,) of the best candidate of each row, and its value (B,)."""
        row, token, flip, _ = candidates
        own = self._networks.critic(scene.pairs(*candidates).at(proposed))
        listed = _best_of_each(row, own, len(scene.pose))
        chosen = listed.reshape(-1)
        known = chosen >= 0
        total = torch.full((len(chosen),), -torch.inf)
        at = chosen[known]
        total[known] = self._total(scene, row[at], token[at], flip[at], proposed[at])
        value, place = total.view(listed.shape).max(dim=1)
        return listed.gather(1, place[:, None])[:, 0], value

    def _total(
        self, scene: _Scene, row: Tensor, token: Tensor, flip: Tensor, pose: Tensor
    ) -> Tensor:
        """(M,) values of poses (M, 3) over all pieces of the target."""
        count = self._layout.tokens
        rows, tokens, flips = (part.repeat_interleave(count) for part in (row, token, flip))
        pairs = scene.pairs(rows, tokens, flips, torch.arange(count).repeat(len(row)))
        values: Tensor = self._networks.critic(pairs.at(pose.repeat_interleave(count, dim=0)))
        return values.view(-1, count).sum(dim=1)

    def _refined(
        self, scene: _Scene, row: Tensor, token: Tensor, flip: Tensor, pose: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Poses (B, 3) after gradient steps uphill on the critic, and their values (B,)."""
        with torch.enable_grad():
            moved = pose.clone().requires_grad_(True)
            optimiser = torch.optim.Adam([moved], lr=self._agent.refine_rate)
            for _ in range(self._agent.refine_steps):
                loss = -self._total(scene, row, token, flip, moved).sum()
                (moved.grad,) = torch.autograd.grad(loss, [moved])
                optimiser.step()
        with torch.no_grad():
            value = self._total(scene, row, token, flip, moved)
        return moved.detach(), value


def _best_of_each(row: Tensor, own: Tensor, rows: int) -> Tensor:
    """(B, L) indices of the best few candidates of each row, filled up with -1.

    Candidates come row after row.
    """
    counts = torch.bincount(row, minlength=rows)
    first = counts.cumsum(0) - counts
    table = torch.full((rows, int(counts.max())), -torch.inf)
    table[row, torch.arange(len(row)) - first[row]] = own
    best = table.topk(min(_SHORT_LIST, table.shape[1]), dim=1)
    return torch.where(best.values > -torch.inf, best.indices + first[:, None], -1)


def _ranks(order: str, layout: Layout, goals: Floats) -> Floats:
    """(B, K) which token comes first, by a rule that was not learned."""
    count = layout.tokens
    if order == "size":
        areas = np.array([shape.area for shape in layout.shapes])
        return np.broadcast_to(np.argsort(np.argsort(-areas, kind="stable")), (len(goals), count))
    if order == "random":
        # By the target, which stays for the whole episode: a policy has no memory.
        seeds = [zlib.crc32(np.asarray(goal, np.float32).tobytes()) for goal in goals]
        return np.stack([np.random.default_rng(seed).permutation(count) for seed in seeds])
    return np.broadcast_to(np.arange(count), (len(goals), count))


def _tensor(array: Floats | Bools) -> Tensor:
    return torch.from_numpy(np.array(array, np.float32))
