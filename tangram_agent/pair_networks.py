"""Actor and critic of pairs: a pose for each, and how much of the target's piece that covers.

Legend: M pairs, F features, W width.
"""

import torch
from torch import Tensor, nn

from tangram_agent.attention import GraphEncoder
from tangram_agent.config import NetConfig
from tangram_agent.networks import perceptron
from tangram_agent.pairs import PairGraph, Pairs

POSE = 4  # shift in x and y, and the turn as a cosine and a sine


class PairHead(nn.Module):
    """Outputs (M, outputs) of pairs, by attention over a pair's graph or by a perceptron.

    Attention reads the token's base, joined to the projected mean of all nodes.
    """

    def __init__(self, graph: PairGraph, net: NetConfig, outputs: int) -> None:
        super().__init__()
        self.graph, self.attends = graph, net.kind == "mha"
        if self.attends:
            self.encoder = GraphEncoder(graph.features, net)
            self.context = nn.Linear(net.width, net.width, bias=False)
            self.readout = nn.Linear(2 * net.width, outputs)
        else:
            self.layers = perceptron(graph.inputs, net.hidden, outputs)

    def forward(self, pairs: Pairs) -> Tensor:
        """(M, outputs)."""
        outputs: Tensor
        if not self.attends:
            outputs = self.layers(self.graph.vectors(pairs))
            return outputs
        nodes, mean = self.encoder(self.graph.node_features(pairs), self.graph.adjacency)
        base = nodes[:, self.graph.corners]
        outputs = self.readout(torch.cat([base, self.context(mean)], dim=-1))
        return outputs


class PairActor(nn.Module):
    """pi: where to put a token so that it covers a piece of the target."""

    def __init__(self, graph: PairGraph, net: NetConfig) -> None:
        super().__init__()
        self.graph = graph
        self.head = PairHead(graph, net, POSE)

    def forward(self, pairs: Pairs) -> tuple[Tensor, Tensor]:
        """Poses (M, 3), and the pre-activations (M, 2) of their shifts."""
        raw = self.head(pairs)
        shift = raw[:, :2].clamp(-1.0, 1.0) * self.graph.arena
        angle = self.graph.turn_of(raw[:, 2:], pairs.token)
        return self.graph.moved(pairs, shift, angle), raw[:, :2]


class PairCritic(nn.Module):
    """Q: the area of a piece that a token newly covers where it lies, over the larger's area."""

    def __init__(self, graph: PairGraph, net: NetConfig) -> None:
        super().__init__()
        self.head = PairHead(graph, net, 1)

    def forward(self, pairs: Pairs) -> Tensor:
        """Values (M,)."""
        value: Tensor = self.head(pairs).squeeze(-1)
        return value


class PairNetworks(nn.Module):
    """What a worker plays with: the actor proposes, the critic chooses."""

    def __init__(self, graph: PairGraph, net: NetConfig) -> None:
        super().__init__()
        self.actor = PairActor(graph, net)
        self.critic = PairCritic(graph, net)
