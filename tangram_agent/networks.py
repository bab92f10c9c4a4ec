"""Actors and critics: multi-head attention and multi-layer perceptrons.

Legend: B batch, K tokens, V corners, N nodes, F features, W width, A entries of an action.

An actor gives for each graph a velocity (B, 3) of the token that is to move and the
pre-activations that it came from. A critic values a graph and a velocity (B, 3).
"""

import math

import torch
from torch import Tensor, nn

from tangram_agent.attention import GraphEncoder
from tangram_agent.config import AgentConfig, NetConfig
from tangram_agent.graph import TokenGraph

VELOCITY = 3


class AttentionReadout(nn.Module):
    """Encoder with a readout per node: the node's embedding joined to the projected mean."""

    def __init__(self, graph: TokenGraph, net: NetConfig, outputs: int) -> None:
        super().__init__()
        self.graph = graph
        self.encoder = GraphEncoder(graph.features, net)
        self.context = nn.Linear(net.width, net.width, bias=False)
        self.readout = nn.Linear(2 * net.width, outputs)

    def forward(self, features: Tensor, token: Tensor) -> Tensor:
        """(B, N, F), (B,) -> (B, outputs) read at the token's base.

        The paper computes actions for all nodes and extracts the base's: the same numbers.
        """
        nodes, mean = self.encoder(features, self.graph.adjacency)
        rows = torch.arange(len(nodes), device=nodes.device)
        base = nodes[rows, self.graph.base_node(token)]
        outputs: Tensor = self.readout(torch.cat([base, self.context(mean)], dim=-1))
        return outputs


class PerceptronReadout(nn.Module):
    """The baseline: all node features in one vector, one group of outputs per token."""

    def __init__(self, graph: TokenGraph, net: NetConfig, outputs: int) -> None:
        super().__init__()
        self.tokens = graph.tokens
        self.layers = perceptron(graph.nodes * graph.features, net.hidden, outputs * graph.tokens)

    def forward(self, features: Tensor, token: Tensor) -> Tensor:
        """(B, N, F), (B,) -> (B, outputs) of the token."""
        outputs: Tensor = self.layers(features.flatten(1))
        if self.tokens == 1:
            return outputs
        groups = outputs.view(len(outputs), self.tokens, -1)
        chosen: Tensor = groups[torch.arange(len(groups), device=groups.device), token]
        return chosen


class AttentionValue(nn.Module):
    """Encoder with a global readout: one value from the mean of the nodes."""

    def __init__(self, graph: TokenGraph, net: NetConfig, extra: int) -> None:
        super().__init__()
        self.graph = graph
        self.encoder = GraphEncoder(graph.features + extra, net)
        self.context = nn.Linear(net.width, net.width, bias=False)
        self.readout = nn.Linear(net.width, 1)

    def forward(self, features: Tensor, token: Tensor, velocity: Tensor | None) -> Tensor:
        """(B, N, F), (B,), velocity (B, 3) or None -> (B,).

        The velocity is appended to the token's base node; other nodes carry zeros there.
        """
        if velocity is not None:
            appended = features.new_zeros(len(features), self.graph.nodes, VELOCITY)
            rows = torch.arange(len(features), device=features.device)
            appended[rows, self.graph.base_node(token)] = velocity
            features = torch.cat([features, appended], dim=-1)
        mean = self.encoder(features, self.graph.adjacency)[1]
        value: Tensor = self.readout(self.context(mean)).squeeze(-1)
        return value


class PerceptronValue(nn.Module):
    """The baseline critic: features and velocity in one vector."""

    def __init__(self, graph: TokenGraph, net: NetConfig, extra: int) -> None:
        super().__init__()
        self.layers = perceptron(graph.nodes * graph.features + extra, net.hidden, 1)

    def forward(self, features: Tensor, token: Tensor, velocity: Tensor | None) -> Tensor:
        """(B, N, F), (B,), velocity (B, 3) or None -> (B,)."""
        del token
        flat = features.flatten(1)
        joined = flat if velocity is None else torch.cat([flat, velocity], dim=-1)
        value: Tensor = self.layers(joined).squeeze(-1)
        return value


class Actor(nn.Module):
    """pi(s, g): which velocity to give to a token."""

    def __init__(self, graph: TokenGraph, agent: AgentConfig, net: NetConfig) -> None:
        super().__init__()
        self.graph = graph
        self.kfold, self.clamp = agent.angle_head == "kfold", agent.squash == "clamp"
        outputs = VELOCITY + self.kfold
        kind = AttentionReadout if net.kind == "mha" else PerceptronReadout
        self.head = kind(graph, net, outputs)

    def forward(
        self,
        corners: Tensor,
        placed: Tensor,
        goal: Tensor,
        token: Tensor,
        features: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Velocity (B, 3) in [-1, 1] in the world's frame, and pre-activations (B, outputs).

        Features (B, N, F) of just this state may be handed in where they were made before.
        """
        if features is None:
            features = self.graph.node_features(corners, placed, goal, token)
        raw = self.head(features, token)
        shift = self.graph.to_world(corners, token, self._squash(raw[:, :2]))
        velocity = torch.cat([shift, self._angle(raw[:, 2:], token)], dim=-1)
        return velocity.clamp(-1.0, 1.0), raw

    def _squash(self, raw: Tensor) -> Tensor:
        return raw.clamp(-1.0, 1.0) if self.clamp else torch.tanh(raw)

    def _angle(self, raw: Tensor, token: Tensor) -> Tensor:
        """The turn as a share of pi, (B, 1).

        The k-fold head needs no more than 1/k of a half turn either way, and has no seam where
        two equally good turns meet.
        """
        if not self.kfold:
            return self._squash(raw)
        angle = torch.atan2(raw[:, 1], raw[:, 0]) / self.graph.symmetry[token]
        return angle[:, None] / math.pi


class Critic(nn.Module):
    """Q(s, g, a): what a velocity of a token is worth."""

    def __init__(self, graph: TokenGraph, agent: AgentConfig, net: NetConfig) -> None:
        super().__init__()
        self.graph, self.afterstate = graph, agent.afterstate
        kind = AttentionValue if net.kind == "mha" else PerceptronValue
        self.head = kind(graph, net, 0 if agent.afterstate else VELOCITY)

    def forward(
        self,
        corners: Tensor,
        placed: Tensor,
        goal: Tensor,
        token: Tensor,
        velocity: Tensor,
        features: Tensor | None = None,
    ) -> Tensor:
        """Values (B,).

        An afterstate critic sees the graph as the velocity would leave it, a known rigid motion,
        instead of the velocity itself. Features are as for the actor; it makes its own.
        """
        if self.afterstate:
            moved = self.graph.move(corners, token, velocity)
            value: Tensor = self.head(
                self.graph.node_features(moved, placed, goal, token), token, None
            )
            return value
        if features is None:
            features = self.graph.node_features(corners, placed, goal, token)
        shift = self.graph.to_token(corners, token, velocity[:, :2])
        action = torch.cat([shift, velocity[:, 2:]], dim=-1)
        valued: Tensor = self.head(features, token, action)
        return valued


def perceptron(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    """Linear layers with ReLU between."""
    layers: list[nn.Module] = []
    for size in hidden:
        layers += [nn.Linear(inputs, size), nn.ReLU()]
        inputs = size
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def initialise(module: nn.Module, generator: torch.Generator) -> None:
    """Uniform weights and biases within 1/sqrt(inputs), from an explicit generator."""
    with torch.no_grad():
        for layer in module.modules():
            if isinstance(layer, nn.Linear):
                bound = 1.0 / math.sqrt(layer.in_features)
                layer.weight.uniform_(-bound, bound, generator=generator)
                if layer.bias is not None:
                    layer.bias.uniform_(-bound, bound, generator=generator)


def parameter_count(*modules: nn.Module) -> int:
    """Trainable numbers of all modules together (Table I)."""
    return sum(p.numel() for module in modules for p in module.parameters() if p.requires_grad)
