"""Actor and critic of pairs of a token and a piece of the target.

Legend: M pairs.
"""

import math

import torch
from torch import Tensor, nn

from tangram_agent.agents.pair.pairs import PairGraph, Pairs
from tangram_agent.base.config import NetConfig
from tangram_agent.nets.networks import VELOCITY, Head
from tangram_sim.geometry.layout import Layout


class ActorNet(nn.Module):
    """pi(s, g): the velocity that takes the token onto the piece.

    The shift is clamped. The angle of two outputs, divided by the token's symmetry k, is the turn.
    So it is at most 1/k of a half turn either way, and does not jump where two equally good turns
    meet.
    """

    def __init__(self, graph: PairGraph, net: NetConfig) -> None:
        super().__init__()
        self.graph = graph
        self.head = Head(graph, net, VELOCITY + 1, at_base=True)

    def forward(self, pairs: Pairs, features: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Velocity (M, 3) in [-1, 1] in the arena's axes, and (M, 2) the shift before its clamp.

        `features` are as in `Head.forward`.
        """
        raw = self.head(pairs, features=features)
        angle = torch.atan2(raw[:, 3], raw[:, 2]) / self.graph.symmetry[pairs.token] / math.pi
        return self.graph.velocity(pairs, raw[:, :2].clamp(-1.0, 1.0), angle), raw[:, :2]


class CriticNet(nn.Module):
    """Q(s, g, a): the value of a velocity, from the pair after the motion (the afterstate)."""

    def __init__(self, graph: PairGraph, net: NetConfig) -> None:
        super().__init__()
        self.graph = graph
        self.head = Head(graph, net, 1, at_base=True)

    def forward(
        self,
        pairs: Pairs,
        velocity: Tensor,
        after: Pairs | None = None,
        _features: Tensor | None = None,
    ) -> Tensor:
        """Values (M,).

        Args:
            pairs: the pairs before the motion.
            velocity: (M, 3) in the arena's axes.
            after: the observed pairs after the motion; None: computed by the exact motion.
        """
        seen = self.graph.moved(pairs, velocity) if after is None else after
        value: Tensor = self.head(seen).squeeze(-1)
        return value


class Networks(nn.Module):
    """Actor and critic, as they act: the critic chooses among the actor's proposals."""

    def __init__(self, layout: Layout, arena: float, net: NetConfig) -> None:
        super().__init__()
        graph = PairGraph(layout, arena)
        self.actor, self.critic = ActorNet(graph, net), CriticNet(graph, net)
