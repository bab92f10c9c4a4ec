"""The policy of SAC: a Gaussian through tanh.

Legend: B rows, F entries of a row, A entries of an action.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from tangram_agent.flat.config import BaseConfig
from tangram_agent.flat.networks import Policy
from tangram_agent.nets.networks import perceptron, untraced

LOWEST, HIGHEST = -5.0, 2.0  # bounds of the logarithm of a standard deviation


class GaussianPolicy(Policy):
    """Mean and standard deviation of actions before tanh (Haarnoja et al. 2018, appendix C)."""

    def __init__(self, inputs: int, actions: int, config: BaseConfig) -> None:
        super().__init__(inputs, actions, config)
        self.layers = perceptron(inputs, config.hidden, 2 * actions, norm=True)

    def forward(self, rows: Tensor) -> Tensor:
        """Actions (B, A) of the mean, after tanh."""
        untraced()
        return torch.tanh(self.layers(rows)[:, : self.actions])

    def explore(self, rows: Tensor, normals: Tensor) -> Tensor:
        """Random actions (B, A) from standard normals (B, A)."""
        return self.drawn(rows, normals)[0]

    def drawn(self, rows: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Random actions (B, A) from standard normals (B, A), and their log densities (B,)."""
        mean, raw = self.layers(rows).chunk(2, dim=-1)
        log_deviation = LOWEST + (HIGHEST - LOWEST) * torch.sigmoid(raw)
        before = mean + log_deviation.exp() * normals
        # log N - log(1 - tanh^2 u); the latter as 2 (log 2 - u - softplus(-2u)), exact for large u.
        density = -0.5 * normals.square() - log_deviation - 0.5 * math.log(2.0 * math.pi)
        squashed = 2.0 * (math.log(2.0) - before - softplus(-2.0 * before))
        return torch.tanh(before), (density - squashed).sum(dim=-1)


class Temperature(nn.Module):
    """The weight of the entropy, learned as its logarithm."""

    def __init__(self) -> None:
        super().__init__()
        self.logarithm = nn.Parameter(torch.tensor(math.log(0.1)))

    def forward(self) -> Tensor:
        """The temperature ()."""
        return self.logarithm.exp()
