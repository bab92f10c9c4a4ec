"""The networks as the guide of a look ahead: the actor's places, the critic's values and pushes.

Legend: K tokens, M options.
"""

import numpy as np
import torch
from torch import Tensor

from tangram_agent.contacts import Contacts
from tangram_agent.coverage import Lying
from tangram_agent.foresight import Places, Table
from tangram_agent.networks import Networks
from tangram_agent.pairs import PairGraph, Pairs
from tangram_agent.setup import Setup
from tangram_sim.arrays import Bools, Floats, Ints

_WORTH = 0.5  # value from which on a place is proposed,
_PIECES = 3  # and for at most so many pieces for each token
_NOISE = 0.03  # shares that are predicted for tokens which stay where they are


class NetworkGuide:
    """See `tangram_agent.foresight.Guide`."""

    def __init__(self, networks: Networks, setup: Setup, contacts: Contacts | None = None) -> None:
        self._networks, self._reapply, self._contacts = networks, setup.agent.reapply, contacts
        self._graph = PairGraph(setup.layout, setup.sim.arena, setup.agent)

    @torch.no_grad()
    def places(self, table: Table, left: Bools, covered: Floats) -> Places:
        """The actor's poses for the pieces that its critic likes best, token by token."""
        row, token, piece = np.nonzero(left[:, :, None] & (covered < 1.0)[:, None])
        start, taken = table.poses[row, token], covered[row, piece]
        pairs = self._pairs(table, token, start, piece, taken)
        pose = self.proposed(pairs)
        for _ in range(self._reapply):
            pose = self.proposed(pairs.at(pose))
        way = self._graph.way(pairs, pose)
        value = self._networks.critic(pairs, way, pairs.at(pose)).numpy().astype(np.float64)
        own = row * left.shape[1] + token
        ranks = ((own == own[:, None]) & (value > value[:, None])).sum(axis=1)
        kept = (ranks == 0) | ((ranks < _PIECES) & (value >= _WORTH))
        poses = pose.numpy().astype(np.float64)
        chosen = row[kept], token[kept], piece[kept]
        return Places(*chosen, poses[kept], np.clip(value[kept], 0.0, 1.0))

    @torch.no_grad()
    def pushed(self, table: Table, token: Ints, start: Floats, end: Floats) -> Floats:
        """What becomes of a token of the piece's shape that lies there.

        By the model of contacts, or where none is at hand by the critic's second head.
        """
        if self._contacts is not None:
            kinds = self._contacts.kinds
            movers = Lying(kinds[token], start, table.flipped[token])
            pieces = Lying(kinds, table.goal, table.goal_flipped)
            return self._contacts.pushed(movers, end, pieces)
        count = len(table.goal)
        index, piece = (
            np.repeat(np.arange(len(token)), count),
            np.tile(np.arange(count), len(token)),
        )
        none = np.zeros(len(piece))
        pairs = self._pairs(table, token[index], start[index], piece, none)
        share = self._networks.critic.pushed(pairs, as_tensor(end[index])).numpy()
        share = share.reshape(len(token), count).astype(np.float64)
        return np.where(share > _NOISE, np.minimum(share, 1.0), 0.0)

    def proposed(self, pairs: Pairs) -> Tensor:
        """Poses (M, 3) that the actor gives to the tokens of pairs."""
        velocity, _ = self._networks.actor(pairs)
        return self._graph.moved(pairs, velocity).pose

    def _pairs(
        self, table: Table, token: Ints, pose: Floats, piece: Ints, covered: Floats
    ) -> Pairs:
        return Pairs(
            pose=as_tensor(pose),
            flipped=as_tensor(table.flipped[token]),
            token=torch.from_numpy(token),
            goal=as_tensor(table.goal[piece]),
            goal_flipped=as_tensor(table.goal_flipped[piece]),
            piece=torch.from_numpy(piece),
            covered=as_tensor(covered),
        )


def as_tensor(array: Floats | Bools) -> Tensor:
    """A copy in single precision."""
    return torch.from_numpy(np.array(array, np.float32))
