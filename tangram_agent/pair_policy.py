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

from tangram_agent.pair_damage import damage
from tangram_agent.pair_networks import PairNetworks
from tangram_agent.pair_scene import Candidates, Scene
from tangram_agent.pair_values import covered_share, covering, worths
from tangram_agent.setup import Setup
from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.layout import Layout

_SHORT_LIST = 8  # proposals of an environment that are valued for all pieces


@dataclass(frozen=True, eq=False)
class Choice:
    """What B environments play.

    Attributes:
        token: (B,) which token.
        flip: (B,) whether it is turned over.
        start: (B, 3) where it lies.
        pose: (B, 3) where it goes.
    """

    token: Ints
    flip: Bools
    start: Floats
    pose: Floats


class PairChooser:
    """Chooses token, side and pose."""

    def __init__(self, networks: PairNetworks, setup: Setup) -> None:
        self._networks, self._layout, self._agent = networks, setup.layout, setup.agent
        self._contacts = setup.contacts
        self._turns_over = setup.layout.chiral & setup.sim.allow_flip

    def choose(self, corners: Floats, placed: Bools, goals: Floats, refine: bool = True) -> Choice:
        """What to play; where all tokens are placed, some action of the first one.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) which tokens are placed.
            goals: (B, V, 2) of the target.
            refine: take the gradient steps that the agent is configured for.
        """
        start = self._layout.poses(corners)
        scene = self._scene(corners, start, goals)
        with torch.no_grad():
            candidates, pose = self._short_list(scene, self._open(placed, goals))
            best = self._best(scene, candidates, pose)
        chosen, pose = candidates.at(best), pose[best]
        if refine and self._agent.refine_steps:
            pose = self._refined(scene, chosen, pose)
        token = chosen.token.numpy()
        return Choice(
            token=token,
            flip=chosen.flip.numpy() > 0.5,
            start=start[np.arange(len(token)), token],
            pose=pose.numpy().astype(np.float64),
        )

    def _scene(self, corners: Floats, start: Floats, goals: Floats) -> Scene:
        layout = self._layout
        covered = covering(corners, goals, layout)
        return Scene(
            pose=_tensor(start),
            flipped=_tensor(layout.flipped(corners)),
            goal=_tensor(layout.poses(goals)),
            goal_flipped=_tensor(layout.flipped(goals)),
            covered=_tensor(covered_share(covered, layout)),
            worth=_tensor(worths(covered, layout)),
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

    def _short_list(self, scene: Scene, is_open: Bools) -> tuple[Candidates, Tensor]:
        """The best few of all pairs that may be played, by their own piece's value, and poses.

        The actor is applied again to its own proposals as often as it is configured.
        """
        sides = np.stack([is_open, is_open & self._turns_over], axis=-1)
        every = np.broadcast_to(sides[..., None], (*sides.shape, self._layout.tokens))
        row, token, flip, piece = map(torch.from_numpy, np.nonzero(every))
        candidates = Candidates(row, token, flip.float(), piece)
        pairs = scene.pairs(candidates)
        pose: Tensor = self._networks.actor(pairs)[0]
        best = candidates.best(self._networks.critic(pairs.at(pose)), _SHORT_LIST)
        candidates, pose = candidates.at(best), pose[best]
        pairs = scene.pairs(candidates)
        for _ in range(self._agent.reapply):
            pose = self._networks.actor(pairs.at(pose))[0]
        return candidates, pose

    def _best(self, scene: Scene, candidates: Candidates, pose: Tensor) -> Tensor:
        """Index (B,) of the best candidate of each row."""
        # What a token covers already it gives up.
        total = self._total(scene, candidates, pose) - scene.worth[candidates.row, candidates.token]
        if self._contacts:
            critic, gamma = self._networks.critic, self._agent.gamma
            total = total - damage(critic, gamma, scene, candidates, pose, total)
        return candidates.best(total, 1)

    def _total(self, scene: Scene, candidates: Candidates, pose: Tensor) -> Tensor:
        """(M,) values of poses (M, 3) over all pieces of the target."""
        count = self._layout.tokens
        every = candidates.at(torch.arange(len(pose)).repeat_interleave(count))
        pairs = scene.pairs(replace(every, piece=torch.arange(count).repeat(len(pose))))
        values: Tensor = self._networks.critic(pairs.at(pose.repeat_interleave(count, dim=0)))
        return values.view(-1, count).sum(dim=1)

    def _refined(self, scene: Scene, chosen: Candidates, pose: Tensor) -> Tensor:
        """Poses (B, 3) after gradient steps uphill on what the critic says they cover."""
        with torch.enable_grad():
            moved = pose.clone().requires_grad_(True)
            optimiser = torch.optim.Adam([moved], lr=self._agent.refine_rate)
            for _ in range(self._agent.refine_steps):
                loss = -self._total(scene, chosen, moved).sum()
                (moved.grad,) = torch.autograd.grad(loss, [moved])
                optimiser.step()
        return moved.detach()


def _ranks(order: str, layout: Layout, goals: Floats) -> Floats:
    """(B, K) which token comes first, by a rule that was not learned."""
    count = layout.tokens
    if order == "size":
        # Equal areas stay in the set's order, whatever their rounding.
        size = np.round(layout.areas / layout.areas.max(), 9)
        rank = np.argsort(np.argsort(-size, kind="stable"))
        return np.broadcast_to(rank, (len(goals), count))
    if order == "random":
        # By the target, which stays for the whole episode: a policy has no memory.
        seeds = [zlib.crc32(np.asarray(goal, np.float32).tobytes()) for goal in goals]
        return np.stack([np.random.default_rng(seed).permutation(count) for seed in seeds])
    return np.broadcast_to(np.arange(count), (len(goals), count))


def _tensor(array: Floats | Bools) -> Tensor:
    return torch.from_numpy(np.array(array, np.float32))
