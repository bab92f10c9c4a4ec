"""Acting with several tokens: a pose proposed for every pair, and the best of them played.

The critic values each proposal for its own piece; the best few are then valued for all pieces of
the target, as an action is worth the sum of what it covers.

Legend: B environments, K tokens, V corners, M candidates (pairs of all environments).
"""

import zlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tangram_agent.pair_batch import covers
from tangram_agent.pair_networks import PairNetworks
from tangram_agent.pairs import Pairs
from tangram_agent.setup import Setup
from tangram_sim.arrays import Bools, Floats, Ints, Singles
from tangram_sim.layout import Layout

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
class _Candidates:
    """M actions that may be played, row after row: each takes a token to a piece of the target.

    Attributes:
        row: (M,) environment.
        token: (M,) which token.
        flip: (M,) 1 where it is turned over.
        piece: (M,) which piece it is meant for.
    """

    row: Tensor
    token: Tensor
    flip: Tensor
    piece: Tensor

    def at(self, index: Tensor) -> "_Candidates":
        """Some of them."""
        return _Candidates(*(part[index] for part in vars(self).values()))


@dataclass(frozen=True, eq=False)
class _Scene:
    """B environments as tensors.

    Poses and goals are (B, K, 3), sides, covered shares and worths (B, K). A placed token's worth
    is the sum of the values of what it covers, an open one's is 0.
    """

    pose: Tensor
    flipped: Tensor
    goal: Tensor
    goal_flipped: Tensor
    covered: Tensor
    worth: Tensor

    def between(self, movers: _Candidates, where: Tensor, other: Tensor) -> Pairs:
        """Pairs (M,) of tokens that move and others (M,) that lie at poses (M, 3)."""
        return Pairs(
            pose=self.pose[movers.row, movers.token],
            flipped=(self.flipped[movers.row, movers.token] - movers.flip).abs(),
            token=movers.token,
            goal=where,
            goal_flipped=self.flipped[movers.row, other],
            piece=other,
            covered=torch.zeros(len(other)),
        )

    def pairs(self, c: _Candidates) -> Pairs:
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


class PairChooser:
    """Chooses token, side and pose."""

    def __init__(self, networks: PairNetworks, setup: Setup) -> None:
        self._networks, self._layout, self._agent = networks, setup.layout, setup.agent
        self._contacts = setup.contacts
        self._turns_over = setup.layout.chiral & setup.sim.allow_flip

    def choose(self, corners: Floats, placed: Bools, goals: Floats, refine: bool = True) -> Choice:
        """What to play, where every environment still has a token to place.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) which tokens are placed; where all are, the first one is named.
            goals: (B, V, 2) of the target.
            refine: take the gradient steps that the agent is configured for.
        """
        scene = self._scene(corners, goals)
        with torch.no_grad():
            candidates = self._candidates(scene, self._open(placed, goals))
            pose = self._proposed(scene, candidates)
            best, value = self._best(scene, candidates, pose)
        chosen, pose = candidates.at(best), pose[best]
        if refine and self._agent.refine_steps:
            pose, value = self._refined(scene, chosen, pose)
        return Choice(
            chosen.token.numpy(),
            chosen.flip.numpy() > 0.5,
            pose.numpy().astype(np.float64),
            value.numpy(),
        )

    def _scene(self, corners: Floats, goals: Floats) -> _Scene:
        layout = self._layout
        areas = np.array([shape.area for shape in layout.shapes])
        area = covers(corners, goals, layout)
        others = area.sum(axis=1, keepdims=True) - area
        worth = (area / np.maximum(areas[:, None], areas)).sum(axis=2)
        return _Scene(
            _tensor(layout.poses(corners)),
            _tensor(layout.flipped(corners)),
            _tensor(layout.poses(goals)),
            _tensor(layout.flipped(goals)),
            _tensor(np.minimum(others / areas, 1.0)),
            _tensor(worth),
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

    def _candidates(self, scene: _Scene, is_open: Bools) -> _Candidates:
        """The best few of all pairs that may be played, by their own piece's value."""
        sides = np.stack([is_open, is_open & self._turns_over], axis=-1)
        every = np.broadcast_to(sides[..., None], (*sides.shape, self._layout.tokens))
        row, token, flip, piece = map(torch.from_numpy, np.nonzero(every))
        candidates = _Candidates(row, token, flip.float(), piece)
        pairs = scene.pairs(candidates)
        value = self._networks.critic(pairs.at(self._networks.actor(pairs)[0]))
        return candidates.at(_best_of_each(row, value, len(is_open)))

    def _proposed(self, scene: _Scene, candidates: _Candidates) -> Tensor:
        """Poses (M, 3), the actor applied again to its own as often as it is configured."""
        pairs = scene.pairs(candidates)
        pose: Tensor = self._networks.actor(pairs)[0]
        for _ in range(self._agent.reapply):
            pose = self._networks.actor(pairs.at(pose))[0]
        return pose

    def _best(self, scene: _Scene, candidates: _Candidates, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Index (B,) of the best candidate of each row, and its value (B,)."""
        total = self._total(scene, candidates, pose)
        total = total - scene.worth[candidates.row, candidates.token]
        if self._contacts:
            total = total - self._damage(scene, candidates, pose, total)
        table, first = _by_row(candidates.row, total, len(scene.pose))
        value, place = table.max(dim=1)
        return place + first, value

    def _total(self, scene: _Scene, candidates: _Candidates, pose: Tensor) -> Tensor:
        """(M,) values of poses (M, 3) over all pieces of the target."""
        count = self._layout.tokens
        pieces = torch.arange(count).repeat(len(pose))
        every = candidates.at(torch.arange(len(pose)).repeat_interleave(count))
        pairs = scene.pairs(replace(every, piece=pieces))
        values: Tensor = self._networks.critic(pairs.at(pose.repeat_interleave(count, dim=0)))
        return values.view(-1, count).sum(dim=1)

    def _damage(
        self, scene: _Scene, candidates: _Candidates, pose: Tensor, value: Tensor
    ) -> Tensor:
        """(M,) what sliding there pushes off the target, and what later pushes will cost it.

        Now: each placed token's worth, times the share that it is pushed away. Later, with the
        weight gamma: the candidate's own value, times the share that every token which is still to
        come pushes it away on the way to the best pose known for it. So what lies in the way of
        others is placed after them.
        """
        now = self._pushed(scene, candidates, pose, scene.worth)
        if self._agent.gamma == 0.0:
            return now
        return now + self._agent.gamma * value * self._pushed_later(scene, candidates, pose, value)

    def _pushed(
        self, scene: _Scene, candidates: _Candidates, pose: Tensor, worth: Tensor
    ) -> Tensor:
        """(M,) sum over tokens of the share that each is pushed away times its worth (B, K)."""
        index, other = torch.nonzero(worth[candidates.row] > 0.0, as_tuple=True)
        keep = candidates.token[index] != other
        index, other = index[keep], other[keep]
        movers = candidates.at(index)
        pairs = scene.between(movers, scene.pose[movers.row, other], other)
        share = self._networks.critic.pushed(pairs, pose[index]).clamp(0.0, 1.0)
        cost = share * worth[movers.row, other]
        return torch.zeros(len(pose)).index_add(0, index, cost)

    def _pushed_later(
        self, scene: _Scene, candidates: _Candidates, pose: Tensor, value: Tensor
    ) -> Tensor:
        """(M,) sum over the tokens to come of the share that each pushes a candidate away."""
        count = len(pose)
        same = candidates.row[:, None] == candidates.row[None, :]
        leader = _leaders(candidates, value)
        later = same & leader[None, :] & (candidates.token[:, None] != candidates.token[None, :])
        index, mover = torch.nonzero(later, as_tuple=True)
        movers, lying = candidates.at(mover), candidates.at(index)
        pairs = scene.between(movers, pose[index], lying.token)
        share = self._networks.critic.pushed(pairs, pose[mover]).clamp(0.0, 1.0)
        return torch.zeros(count).index_add(0, index, share)

    def _refined(self, scene: _Scene, chosen: _Candidates, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (B, 3) after gradient steps uphill on the critic, and their values (B,)."""
        with torch.enable_grad():
            moved = pose.clone().requires_grad_(True)
            optimiser = torch.optim.Adam([moved], lr=self._agent.refine_rate)
            for _ in range(self._agent.refine_steps):
                loss = -self._total(scene, chosen, moved).sum()
                (moved.grad,) = torch.autograd.grad(loss, [moved])
                optimiser.step()
        with torch.no_grad():
            value = self._total(scene, chosen, moved)
        return moved.detach(), value


def _leaders(candidates: _Candidates, value: Tensor) -> Tensor:
    """(M,) which candidate is the best one of its token in its row."""
    key = candidates.row * (int(candidates.token.max()) + 1) + candidates.token
    best = torch.full((int(key.max()) + 1,), -torch.inf).scatter_reduce(0, key, value, "amax")
    return value >= best[key]


def _by_row(row: Tensor, value: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """Values (M,) that come row after row as a table (B, L), and where each row begins (B,)."""
    counts = torch.bincount(row, minlength=rows)
    first = counts.cumsum(0) - counts
    table = torch.full((rows, int(counts.max())), -torch.inf)
    table[row, torch.arange(len(row)) - first[row]] = value
    return table, first


def _best_of_each(row: Tensor, value: Tensor, rows: int) -> Tensor:
    """Indices (M',) of the best few candidates of each row, row after row."""
    table, first = _by_row(row, value, rows)
    best = table.topk(min(_SHORT_LIST, table.shape[1]), dim=1)
    return (best.indices + first[:, None])[best.values > -torch.inf]


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
