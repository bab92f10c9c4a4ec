"""Actor and critic on either graph: multi-head attention or multi-layer perceptrons.

Legend: M views, N nodes, F features, W width.

An actor gives for each view a velocity (M, 3) of the token that is to move, and the pre-activations
that it came from. A critic values a view and a velocity (M, 3).
"""

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from tangram_agent.attention import GraphEncoder
from tangram_agent.config import AgentConfig, NetConfig
from tangram_agent.crops import CropValue
from tangram_agent.filling import Filling
from tangram_agent.graph import Graph
from tangram_agent.motion import MotionModel
from tangram_agent.pairs import PairGraph, Pairs
from tangram_agent.scenes import SceneGraph, Scenes
from tangram_agent.setup import Setup
from tangram_agent.types import Weights
from tangram_agent.values import OutlineValue

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
    """pi(s, g): which velocity to give to the token that is to move."""

    def __init__(self, graph: Graph, agent: AgentConfig, net: NetConfig) -> None:
        super().__init__()
        self.graph = graph
        self.kfold, self.clamp = agent.angle_head == "kfold", agent.squash == "clamp"
        self.head = Head(graph, net, VELOCITY + self.kfold, at_base=True)

    def forward(self, view: View, features: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Velocity (M, 3) in [-1, 1] in the arena's axes, and what of the outputs is squashed.

        Those are pre-activations (M, 3), or of the shift (M, 2) with the k-fold head, whose turn
        has no bound to run into. Features are as for `Head`.
        """
        raw = self.head(view, features=features)
        shift, angle = self._squash(raw[:, :2]), self._angle(raw[:, 2:], view)
        velocity = self.graph.velocity(view, shift, angle)
        return velocity, raw[:, :2] if self.kfold else raw

    def _squash(self, raw: Tensor) -> Tensor:
        return raw.clamp(-1.0, 1.0) if self.clamp else torch.tanh(raw)

    def _angle(self, raw: Tensor, view: View) -> Tensor:
        """The turn as a share of pi, (M,).

        The k-fold head needs no more than 1/k of a half turn either way, and has no seam where
        two equally good turns meet.
        """
        if not self.kfold:
            return self._squash(raw)[:, 0]
        symmetry = self.graph.symmetry_of(view)
        return torch.atan2(raw[:, 1], raw[:, 0]) / symmetry / math.pi


class Critic(nn.Module):
    """Q(s, g, a): what a velocity of the token that is to move is worth.

    An afterstate critic sees the graph as the velocity would leave it, a known rigid motion,
    instead of the velocity itself.
    """

    def __init__(self, graph: Graph, agent: AgentConfig, net: NetConfig) -> None:
        super().__init__()
        self.graph, self.afterstate = graph, agent.afterstate
        self._of_the_rest = agent.credit == "reward"
        action = 0 if agent.afterstate else VELOCITY
        # The paper's value is read off the whole graph; a pair's also at its token.
        at_base = isinstance(graph, PairGraph)
        self.head = Head(graph, net, 1, at_base=at_base, action=action)

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
            features: of the view, as for `Head`; an afterstate critic makes its own.
        """
        if not self.afterstate:
            seen = self.graph.as_seen(view, velocity)
            return self._value(self.head(view, action=seen, features=features))
        moved = self.graph.moved(view, velocity) if after is None else after
        if not self._of_the_rest or not isinstance(moved, Pairs):
            return self._value(self.head(moved))
        # What is covered cannot be covered anew, which scenes of disjoint tokens do not teach.
        bare = replace(moved, covered=torch.zeros_like(moved.covered))
        return self._value(self.head(bare)) * (1.0 - moved.covered)

    def _value(self, outputs: Tensor) -> Tensor:
        return outputs.squeeze(-1)


class Networks(nn.Module):
    """Actor and critic of a setup, on the graph that its agent sees."""

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        seen = setup.layout, setup.sim.arena, setup.agent
        graph: Graph = PairGraph(*seen) if setup.pairs else SceneGraph(*seen)
        self.actor = Actor(graph, setup.agent, setup.net)
        self.critic = Critic(graph, setup.agent, setup.net)
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
    """What an agent of outlines learns: logits (M,) of what is left, by its corners or its crop."""
    kind = CropValue if setup.net.kind == "crops" else OutlineValue
    return kind(Filling(setup.layout).shapes, setup.net)


def travels(name: str, setup: Setup) -> bool:
    """Whether workers need a parameter of `Networks.playing`, of this name, to play.

    Who plays a finished run may set `agent.refine_steps`, so that a checkpoint keeps all of them.
    """
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
            if isinstance(layer, nn.Linear | nn.Conv2d):
                bound = 1.0 / math.sqrt(layer.weight[0].numel())
                layer.weight.uniform_(-bound, bound, generator=generator)
                if layer.bias is not None:
                    layer.bias.uniform_(-bound, bound, generator=generator)


def parameter_count(*modules: nn.Module) -> int:
    """Trainable numbers of all modules together (Table I)."""
    return sum(p.numel() for module in modules for p in module.parameters() if p.requires_grad)
