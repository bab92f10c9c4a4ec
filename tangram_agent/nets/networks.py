"""Layers that read a graph: multi-head attention or a multi-layer perceptron.

Legend: M views, N nodes, F features, W width.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn

from tangram_agent.base.config import NetConfig
from tangram_agent.nets.attention import GraphEncoder
from tangram_agent.nets.graph import Graph
from tangram_core.errors import ConfigError

VELOCITY = 3
_ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh}


class Head(nn.Module):
    """Outputs (M, outputs) of views, by attention over the graph or by a perceptron.

    Attention reads the projected mean of all nodes, and with `at_base` also the embedding of the
    moving token's base. The paper computes actions for all nodes and takes that of the base, which
    gives the same numbers. With `at_base` a perceptron has one group of outputs per token.
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
            graph: the graph of the views.
            net: settings of size and kind.
            outputs: numbers for each view.
            at_base: whether to read at the base of the moving token.
            action: numbers that `forward` appends to the moving token's base node.
        """
        super().__init__()
        self.graph, self.attends, self.at_base = graph, net.kind == "mha", at_base
        if self.attends:
            self.encoder = GraphEncoder(graph.features + action, net)
            self.context = nn.Linear(net.width, net.width, bias=False)
            self.readout = nn.Linear((1 + at_base) * net.width, outputs)
        else:
            groups, kind = graph.tokens if at_base else 1, _ACTIVATIONS[net.activation]
            self.layers = perceptron(graph.inputs + action, net.hidden, outputs * groups, kind=kind)

    def forward(
        self,
        view: Any,
        action: Tensor | None = None,
        features: Tensor | None = None,
    ) -> Tensor:
        """Outputs (M, outputs) of views, with an action (M, action) for a head that takes one.

        `features` are the result of `see`, if it was computed before.

        Raises:
            ConfigError: see `untraced`.
        """
        untraced()
        seen = self.see(view) if features is None else features
        base = self.graph.base_node(view)
        rows = torch.arange(seen.shape[0], device=seen.device)
        outputs: Tensor
        if not self.attends:
            outputs = self.layers(seen if action is None else torch.cat([seen, action], dim=-1))
            if not self.at_base or self.graph.tokens == 1:
                return outputs
            groups = outputs.view(seen.shape[0], self.graph.tokens, -1)
            return groups[rows, base - self.graph.corners]
        if action is not None:
            # All nodes but the base have zeros there.
            appended = seen.new_zeros(*seen.shape[:2], action.shape[-1])
            appended[rows, base] = action
            seen = torch.cat([seen, appended], dim=-1)
        nodes, mean = self.encoder(seen, self.graph.adjacency)
        read = self.context(mean)
        if self.at_base:
            read = torch.cat([nodes[rows, base], read], -1)
        outputs = self.readout(torch.relu(read) if self.encoder.rectified else read)
        return outputs

    def see(self, view: Any) -> Tensor:
        """Inputs of the layers: node features (M, N, F) of views, or one row for each view."""
        seen = self.graph.node_features if self.attends else self.graph.vectors
        return seen(view)


def untraced() -> None:
    """Refuse torch.jit.trace, which would repeat the choices for one scene in all scenes.

    Raises:
        ConfigError: torch.jit.trace is at work.
    """
    if torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
        raise ConfigError(
            "torch.jit.trace would keep the choices made for one scene for all: use tangram-export"
        )


def perceptron(
    inputs: int,
    hidden: tuple[int, ...],
    outputs: int,
    norm: bool = False,
    kind: type[nn.Module] = nn.ReLU,
) -> nn.Sequential:
    """Linear layers with activations of a kind between, each after a LayerNorm if `norm`."""
    layers: list[nn.Module] = []
    for size in hidden:
        layers += [nn.Linear(inputs, size), *([nn.LayerNorm(size)] if norm else []), kind()]
        inputs = size
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def initialise(module: nn.Module, generator: torch.Generator) -> None:
    """Draw weights and biases uniformly within 1/sqrt(inputs), or within a layer's `bound`."""
    with torch.no_grad():
        for layer in module.modules():
            if isinstance(layer, nn.Linear):
                own: float | None = getattr(layer, "bound", None)
                bound = own or 1.0 / math.sqrt(layer.weight[0].numel())
                layer.weight.uniform_(-bound, bound, generator=generator)
                if layer.bias is not None:
                    layer.bias.uniform_(-bound, bound, generator=generator)


def parameter_count(*modules: nn.Module) -> int:
    """Number of trainable parameters of all modules together (Table I)."""
    return sum(p.numel() for module in modules for p in module.parameters() if p.requires_grad)
