"""Perceptrons: policies and critics of rows of numbers.

Legend: B rows, F entries of a row, A entries of an action, C critics.
"""

import torch
from torch import Tensor, nn

from tangram_agent.flat.config import BaseConfig
from tangram_agent.nets.networks import perceptron, untraced


class Policy(nn.Module):
    """Actions of rows, bounded by tanh; Gaussian noise explores.

    Attributes:
        actions: A.
    """

    def __init__(self, inputs: int, actions: int, config: BaseConfig) -> None:
        super().__init__()
        self.layers = perceptron(inputs, config.hidden, actions, norm=True)
        self.actions, self._noise = actions, config.noise

    def forward(self, rows: Tensor) -> Tensor:
        """(B, A) in [-1, 1] of rows (B, F)."""
        untraced()
        return torch.tanh(self.layers(rows))

    def explore(self, rows: Tensor, normals: Tensor) -> Tensor:
        """(B, A) in [-1, 1], with what was drawn from a standard normal (B, A)."""
        actions: Tensor = self(rows) + self._noise * normals
        return actions.clamp(-1.0, 1.0)


class Critics(nn.Module):
    """Values of rows and actions, by several networks that differ in their first weights."""

    def __init__(self, inputs: int, actions: int, config: BaseConfig, count: int = 2) -> None:
        super().__init__()
        self.each = nn.ModuleList(
            perceptron(inputs + actions, config.hidden, 1, norm=True) for _ in range(count)
        )

    def forward(self, rows: Tensor, actions: Tensor) -> Tensor:
        """(C, B)."""
        return torch.stack([self.one(i, rows, actions) for i in range(len(self.each))])

    def one(self, index: int, rows: Tensor, actions: Tensor) -> Tensor:
        """(B,) what one of them says."""
        value: Tensor = self.each[index](torch.cat([rows, actions], dim=-1))
        return value.squeeze(-1)
