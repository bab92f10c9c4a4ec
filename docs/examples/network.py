"""A network of one's own for the paper's agent: each node by itself, then their mean (deep sets).

Train it with: tangram-train agent=docs/examples/network.py:Sets
"""

from dataclasses import dataclass

import torch
from torch import nn

from tangram_agent.agents.scene.agent import Scene
from tangram_agent.agents.scene.networks import ActorNet, CriticNet
from tangram_agent.agents.scene.scenes import SceneGraph
from tangram_agent.nets.networks import perceptron


class SetsHead(nn.Module):
    """Made and called as `tangram_agent.nets.networks.Head` is; M scenes of N nodes."""

    def __init__(self, graph, net, outputs, *, at_base, action=0):
        super().__init__()
        self.graph, width = graph, net.width
        self.nodes = perceptron(graph.features, (width,), width)
        self.read = perceptron(2 * width + action, (width,), outputs)

    def see(self, view):
        return self.graph.node_features(view)  # (M, N, F)

    def forward(self, view, action=None, features=None):
        nodes = self.nodes(self.see(view) if features is None else features)
        rows = torch.arange(len(nodes), device=nodes.device)
        parts = [nodes[rows, self.graph.base_node(view)], nodes.mean(1)]  # who moves, and all
        return self.read(torch.cat([*parts, *([] if action is None else [action])], -1))


@dataclass(frozen=True)
class Sets(Scene):
    """The paper's agent but for its layers."""

    def networks(self, layout):
        graph = SceneGraph(layout)
        return ActorNet(graph, self.net, SetsHead), CriticNet(graph, self.net, SetsHead)
