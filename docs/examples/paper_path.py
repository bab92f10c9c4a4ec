"""The shortest path from the paper's agent to one that learns the angle.

Two changes of its networks, each alone and both, for a square whose motion is known. The row of
docs/paper.md with all three changes was trained like this, the others with Angle, Afterstate,
or agent.actor_delay=51:

    tangram-train agent=docs/examples/paper_path.py:Both sim=paper reward.source=camera \
        net=mha_small service=jobs service.compile=true max_episodes=24000 max_updates=0 \
        agent.flags=false agent.gamma=0.99 agent.polyak=0.999 agent.acting_average=0 \
        agent.actor_lr=5e-4 agent.lr_final=1 agent.saturation_penalty=0 \
        agent.replay_capacity=12500 agent.learning_starts=16 agent.updates_per_transition=3.1875 \
        agent.actor_delay=1 agent.noise=0.1 agent.noise_inside=true agent.uniform_share=0 \
        'agent.hindsight=[{strategy: final}]'
"""

import math
from dataclasses import dataclass, replace

import torch

from tangram_agent.agents.scene.agent import Scene
from tangram_agent.agents.scene.networks import ActorNet, CriticNet
from tangram_agent.agents.scene.scenes import SceneGraph
from tangram_agent.nets.networks import Head

SYMMETRY = 4  # of the square: a quarter of a turn changes nothing
STEP = 2.0  # units that a velocity of 1 moves a token by


def moved(graph, scenes, velocity):
    """The scene as the velocity would leave it: the token's corners (M, V, 2) turned and moved."""
    base = graph.base_weights @ scenes.corners  # (M, 1, 2)
    turn = math.pi * velocity[:, 2]
    c, s = torch.cos(turn)[:, None], torch.sin(turn)[:, None]
    x, y = (scenes.corners - base).unbind(-1)
    turned = torch.stack([c * x - s * y, s * x + c * y], -1)
    return replace(scenes, corners=base + turned + STEP * velocity[:, None, :2])


class AfterstateCritic(CriticNet):
    """Sees the scene after the action in place of scene and action."""

    def __init__(self, graph, net, tanh=False):
        super().__init__(graph, net, tanh=tanh)
        self.head, self.graph = Head(graph, net, 1, at_base=False), graph

    def forward(self, scenes, velocity, _after=None, features=None):
        value = self.head(moved(self.graph, scenes, velocity)).squeeze(-1)
        return torch.tanh(value) if self._tanh else value


class AngleGraph(SceneGraph):
    """Two features more on each node: cosine and sine of four times the angle to the target."""

    def __init__(self, layout, flags=True):
        super().__init__(layout, flags)
        self.features += 2
        self.inputs += 2

    def node_features(self, scenes):
        def turn(corners):
            centred = (corners - corners.mean(1, keepdim=True)).contiguous()
            return (torch.view_as_complex(centred) ** SYMMETRY).mean(1)

        z = turn(scenes.goal) * turn(scenes.corners).conj()
        angle = torch.view_as_real(z / z.abs().clamp(min=1e-9))
        nodes = super().node_features(scenes)
        return torch.cat([nodes, angle[:, None].expand(-1, nodes.shape[1], -1)], -1)


@dataclass(frozen=True)
class Angle(Scene):
    """It is told the angle."""

    graph, critic = AngleGraph, CriticNet

    def networks(self, layout):
        graph = self.graph(layout, self.config.flags)
        actor = ActorNet(graph, self.net, tanh=self.config.actor_tanh)
        return actor, self.critic(graph, self.net, tanh=self.config.critic_tanh)


class Afterstate(Angle):
    """Its critic sees where an action leads."""

    graph, critic = SceneGraph, AfterstateCritic


class Both(Angle):
    """Both of them."""

    critic = AfterstateCritic
