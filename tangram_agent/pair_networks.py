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

    def __init__(self, graph: PairGraph, net: NetConfig, outputs: int, extra: int = 0) -> None:
        super().__init__()
        self.graph, self.attends = graph, net.kind == "mha"
        if self.attends:
            self.encoder = GraphEncoder(graph.features + extra, net)
            self.context = nn.Linear(net.width, net.width, bias=False)
            self.readout = nn.Linear(2 * net.width, outputs)
        else:
            self.layers = perceptron(graph.inputs + extra, net.hidden, outputs)

    def forward(self, pairs: Pairs, extra: Tensor | None = None) -> Tensor:
        """(M, outputs); what is known besides of each pair, (M, extra), is told to every node."""
        outputs: Tensor
        if not self.attends:
            vectors = self.graph.vectors(pairs)
            joined = vectors if extra is None else torch.cat([vectors, extra], dim=-1)
            outputs = self.layers(joined)
            return outputs
        features = self.graph.node_features(pairs)
        if extra is not None:
            everywhere = extra[:, None].expand(-1, features.shape[1], -1)
            features = torch.cat([features, everywhere], dim=-1)
        nodes, mean = self.encoder(features, self.graph.adjacency)
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
    """Q: the area of a piece that a token newly covers where it lies, over the larger's area.

    Where tokens push each other a second head tells how far a token that slides to a pose pushes
    another one out of its place. There the piece of a pair is that other token.
    """

    def __init__(self, graph: PairGraph, net: NetConfig, contacts: bool) -> None:
        super().__init__()
        self.graph = graph
        self.head = PairHead(graph, net, 1)
        self.push_head = PairHead(graph, net, 1, extra=POSE) if contacts else None

    def forward(self, pairs: Pairs) -> Tensor:
        """Values (M,)."""
        value: Tensor = self.head(pairs).squeeze(-1)
        return value

    def pushed(self, pairs: Pairs, to: Tensor) -> Tensor:
        """(M,) share of the other token's area that is pushed away from where it lies.

        Args:
            pairs: a token where it is and another one as the piece.
            to: (M, 3) pose that the token slides to.
        """
        if self.push_head is None:
            return to.new_zeros(len(to))
        share: Tensor = self.push_head(pairs, self.graph.motion(pairs, to)).squeeze(-1)
        return share


class PairNetworks(nn.Module):
    """What a worker plays with: the actor proposes, the critic chooses."""

    def __init__(self, graph: PairGraph, net: NetConfig, contacts: bool) -> None:
        super().__init__()
        self.actor = PairActor(graph, net)
        self.critic = PairCritic(graph, net, contacts)
