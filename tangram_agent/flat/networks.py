"""Perceptrons: policies and critics of rows of numbers.

Legend: B rows, F entries of a row, A entries of an action, C critics.
"""

import torch
from torch import Tensor, nn

from tangram_agent.flat.config import BaseConfig
from tangram_agent.nets.networks import perceptron, untraced


class Policy(nn.Module):
    """Deterministic policy of rows, bounded by tanh, with Gaussian exploration noise.

    Attributes:
        actions: A, entries of an action.
    """

    def __init__(self, inputs: int, actions: int, config: BaseConfig) -> None:
        super().__init__()
        self.layers = perceptron(inputs, config.hidden, actions, norm=True)
        self.actions, self._noise = actions, config.noise

    def forward(self, rows: Tensor) -> Tensor:
        """Actions (B, A) in [-1, 1] for rows (B, F)."""
        untraced()
        return torch.tanh(self.layers(rows))

    def explore(self, rows: Tensor, normals: Tensor) -> Tensor:
        """Actions (B, A) in [-1, 1] with noise, from standard normals (B, A)."""
        actions: Tensor = self(rows) + self._noise * normals
        return actions.clamp(-1.0, 1.0)


class Critics(nn.Module):
    """Several critics of rows and actions, which differ in their first weights."""

    def __init__(self, inputs: int, actions: int, config: BaseConfig, count: int = 2) -> None:
        super().__init__()
        self.each = nn.ModuleList(
            perceptron(inputs + actions, config.hidden, 1, norm=True) for _ in range(count)
        )

    def forward(self, rows: Tensor, actions: Tensor) -> Tensor:
        """Values (C, B) by all critics."""
        return torch.stack([self.one(i, rows, actions) for i in range(len(self.each))])

    def one(self, index: int, rows: Tensor, actions: Tensor) -> Tensor:
        """Values (B,) by one critic."""
        value: Tensor = self.each[index](torch.cat([rows, actions], dim=-1))
        return value.squeeze(-1)
