"""Actor and critic of whole scenes (Sec. IV-A).

Legend: M scenes.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from tangram_agent.agents.scene.scenes import SceneGraph, Scenes
from tangram_agent.base.config import NetConfig
from tangram_agent.nets.networks import VELOCITY, Head


class ActorNet(nn.Module):
    """pi(s, g): the velocity of the token that is to move, bounded by tanh."""

    def __init__(
        self, graph: SceneGraph, net: NetConfig, head: Callable[..., Any] = Head, tanh: int = 1
    ) -> None:
        """Make the layers by `head`, which is used like `Head`; `tanh` counts its applications."""
        super().__init__()
        self.head, self._inner = head(graph, net, VELOCITY, at_base=True), tanh - 1

    def forward(self, scenes: Scenes, features: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Velocity (M, 3) in [-1, 1] in the arena's axes, and (M, 3) before the last tanh.

        `features` are as in `Head.forward`.
        """
        raw = self.head(scenes, features=features)
        for _ in range(self._inner):
            raw = torch.tanh(raw)
        return torch.tanh(raw), raw


class CriticNet(nn.Module):
    """Q(s, g, a): the value of a velocity of the token that is to move (Eq. 3)."""

    def __init__(
        self, graph: SceneGraph, net: NetConfig, head: Callable[..., Any] = Head, tanh: bool = False
    ) -> None:
        """Make the layers by `head`, which is used like `Head`; tanh may bound the values."""
        super().__init__()
        self.head, self._tanh = head(graph, net, 1, at_base=False, action=VELOCITY), tanh

    def forward(
        self,
        scenes: Scenes,
        velocity: Tensor,
        _after: object = None,
        features: Tensor | None = None,
    ) -> Tensor:
        """Values (M,) of velocities (M, 3); `features` are as in `Head.forward`."""
        value: Tensor = self.head(scenes, action=velocity, features=features).squeeze(-1)
        return torch.tanh(value) if self._tanh else value
