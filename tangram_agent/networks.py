"""Actor and critic on either graph: multi-head attention or multi-layer perceptrons.

Legend: M views, N nodes, F features, W width.

An actor gives for each view a velocity (M, 3) of the token that is to move, and the pre-activations
that it came from. A critic values a view and a velocity (M, 3).
"""

import math

import torch
from torch import Tensor, nn

from tangram_agent.agents.outline.filling import Filling
from tangram_agent.agents.outline.values import OutlineValue
from tangram_agent.agents.pair.motion import MotionModel
from tangram_agent.agents.pair.pairs import PairGraph, Pairs
from tangram_agent.agents.scene.scenes import SceneGraph, Scenes
from tangram_agent.base.attention import GraphEncoder
from tangram_agent.base.graph import Graph
from tangram_agent.config import NetConfig
from tangram_agent.setup import Setup
from tangram_agent.types import Weights

View = Scenes | Pairs

VELOCITY = 3


class Head(nn.Module):
    """Outputs (M, outputs) of views, by attention over the graph or by a perceptron.

    Attention reads the mean of all nodes, projected, or (`at_base`) the embedding of the moving
    token's base joined to it. The paper computes actions for all nodes and extracts the base's: the
    same numbers. A perceptron has one group of outputs per token in view.
    """

    def __init__(
        self,
        graph: Graph,
        net: NetConfig,
        outputs: int,
        *,
        at_base: bool,
        action: int = 0,
    ) -> None:
        """Make the layers.

        Args:
            graph: what is seen.
            net: size and kind.
            outputs: numbers for each view.
            at_base: read at the token that moves.
            action: numbers that `forward` appends to the moving token's base node.
        """
        super().__init__()
        self.graph, self.attends, self.at_base = graph, net.kind == "mha", at_base
        if self.attends:
            self.encoder = GraphEncoder(graph.features + action, net)
            self.context = nn.Linear(net.width, net.width, bias=False)
            self.readout = nn.Linear((1 + at_base) * net.width, outputs)
        else:
            groups = graph.tokens if at_base else 1
            self.layers = perceptron(graph.inputs + action, net.hidden, outputs * groups)

    def forward(
        self,
        view: View,
        action: Tensor | None = None,
        features: Tensor | None = None,
    ) -> Tensor:
        """(M, outputs) of views, with an action (M, action) for a head that takes one.

        Features, by `see`, may be handed in where they were made before.
        """
        seen = self.see(view) if features is None else features
        outputs: Tensor
        if not self.attends:
            outputs = self.layers(seen if action is None else torch.cat([seen, action], dim=-1))
            return self._of_token(outputs, view)
        base = self.graph.base_node(view)
        rows = torch.arange(len(seen), device=seen.device)
        if action is not None:
            # Other nodes than the base carry zeros there.
            appended = seen.new_zeros(*seen.shape[:2], action.shape[-1])
            appended[rows, base] = action
            seen = torch.cat([seen, appended], dim=-1)
        nodes, mean = self.encoder(seen, self.graph.adjacency)
        read = self.context(mean)
        outputs = self.readout(torch.cat([nodes[rows, base], read], -1) if self.at_base else read)
        return outputs

    def see(self, view: View) -> Tensor:
        """What the layers take of views: features of nodes (M, N, F), or one row for each."""
        seen = self.graph.node_features if self.attends else self.graph.vectors
        return seen(view)

    def _of_token(self, outputs: Tensor, view: View) -> Tensor:
        """The moving token's group of a perceptron's outputs."""
        if not self.at_base or self.graph.tokens == 1:
            return outputs
        groups = outputs.view(len(outputs), self.graph.tokens, -1)
        rows = torch.arange(len(groups), device=groups.device)
        chosen: Tensor = groups[rows, self.graph.slot(view)]
        return chosen


class Actor(nn.Module):
    """pi(s, g): which velocity to give to the token that is to move.

    On whole scenes tanh bounds three outputs, as is usual. On pairs the shift is clamped, and two
    outputs give the turn by their angle over the token's symmetry k: it needs no more than 1/k of a
    half turn either way, and has no seam where two equally good turns meet.
    """

    def __init__(self, graph: Graph, net: NetConfig) -> None:
        super().__init__()
        self.graph, self.kfold = graph, isinstance(graph, PairGraph)
        self.head = Head(graph, net, VELOCITY + self.kfold, at_base=True)

    def forward(self, view: View, features: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Velocity (M, 3) in [-1, 1] in the arena's axes, and what of the outputs is bounded.

        Those are pre-activations (M, 3), or (M, 2) of the shift on pairs, whose turn has no bound.
        Features are as for `Head`.
        """
        raw = self.head(view, features=features)
        if not isinstance(view, Pairs) or not isinstance(self.graph, PairGraph):
            bounded = torch.tanh(raw)
            return self.graph.velocity(view, bounded[:, :2], bounded[:, 2]), raw
        angle = torch.atan2(raw[:, 3], raw[:, 2]) / self.graph.symmetry_of(view) / math.pi
        return self.graph.velocity(view, raw[:, :2].clamp(-1.0, 1.0), angle), raw[:, :2]


class Critic(nn.Module):
    """Q(s, g, a): what a velocity of the token that is to move is worth.

    On whole scenes it sees the state and the velocity (Eq. 3). On pairs it sees the graph as the
    velocity would leave it, a known rigid motion, instead of the velocity itself: the afterstate.
    """

    def __init__(self, graph: Graph, net: NetConfig) -> None:
        super().__init__()
        self.graph = graph
        # The paper's value is read off the whole graph; a pair's also at its token.
        pairs = isinstance(graph, PairGraph)
        self.head = Head(graph, net, 1, at_base=pairs, action=0 if pairs else VELOCITY)

    def forward(
        self,
        view: View,
        velocity: Tensor,
        after: View | None = None,
        features: Tensor | None = None,
    ) -> Tensor:
        """Values (M,).

        Args:
            view: what the token is moved in.
            velocity: (M, 3) in the arena's axes.
            after: what it came to, where that is known better than by the exact motion.
            features: of a whole scene, as for `Head`; of an afterstate they are made here.
        """
        if not isinstance(view, Pairs) or not isinstance(self.graph, PairGraph):
            outputs = self.head(view, action=velocity, features=features)
        else:
            outputs = self.head(self.graph.moved(view, velocity) if after is None else after)
        value: Tensor = outputs.squeeze(-1)
        return value


class Networks(nn.Module):
    """Actor and critic of a setup, on the graph that its agent sees."""

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        layout = setup.layout
        graph: Graph = PairGraph(layout, setup.sim.arena) if setup.pairs else SceneGraph(layout)
        self.actor, self.critic = Actor(graph, setup.net), Critic(graph, setup.net)
        self.motion = MotionModel() if setup.learns_motion else None
        # Of pairs the critic chooses among what the actor proposes: both play.
        self._both_play = setup.pairs

    @property
    def playing(self) -> nn.Module:
        """What is kept to play with: the actor, or all networks where the critic may choose.

        What of it travels to workers is less where it has nothing to choose, see `travels`.
        """
        return self if self._both_play else self.actor


def outline_network(setup: Setup) -> nn.Module:
    """What an agent of outlines learns: logits (M,) of what is left, by its corners."""
    return OutlineValue(Filling(setup.layout).shapes, setup.net)


def travels(name: str, setup: Setup) -> bool:
    """Whether workers need a parameter of `Networks.playing`, of this name, to play."""
    return setup.critic_plays or not name.startswith("critic.")


def travelling(weights: Weights, setup: Setup) -> Weights:
    """Of all weights to play with those that a broadcast brings."""
    needed = {name: tensor for name, tensor in weights.tensors.items() if travels(name, setup)}
    return Weights(weights.version, needed)


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
                bound = 1.0 / math.sqrt(layer.weight[0].numel())
                layer.weight.uniform_(-bound, bound, generator=generator)
                if layer.bias is not None:
                    layer.bias.uniform_(-bound, bound, generator=generator)


def parameter_count(*modules: nn.Module) -> int:
    """Trainable numbers of all modules together (Table I)."""
    return sum(p.numel() for module in modules for p in module.parameters() if p.requires_grad)
