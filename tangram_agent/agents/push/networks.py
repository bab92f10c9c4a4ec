"""The critics of pushes, and the model of a token that is pushed alone.

Legend: n rows, C corners, N pushes.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from tangram_agent.agents.push.scenes import PUSHES, Tokens
from tangram_agent.agents.push.seen import PUSH, Seen, other_numbers, token_numbers
from tangram_agent.nets.networks import perceptron, untraced

_FAR = 0.2  # scale of the motion of a pushed token


class Critic(nn.Module):
    """Critic of pushes: its inputs are the pushed token, another one, and each push."""

    def __init__(self, corners: int, width: int) -> None:
        super().__init__()
        self.token = nn.Linear(token_numbers(corners), width)
        self.other = nn.Sequential(
            perceptron(other_numbers(corners), (width,), width, norm=True), *_ended(width)
        )
        self.others = nn.Linear(width, width)
        self.mixed = nn.Sequential(*_ended(width), nn.Linear(width, width), *_ended(width))
        self.scene, self.push = nn.Linear(width, width), nn.Linear(PUSH, width, bias=False)
        self.value = nn.Sequential(*_ended(width), perceptron(width, (width,), 1, norm=True))

    def forward(self, seen: Seen, pushes: Tensor) -> Tensor:
        """Values (n, N) of pushes (n, N, 22)."""
        untraced()
        other = self.others(self.other(seen.other) * seen.there)
        scene = self.scene(self.mixed(self.token(seen.token) + other))
        value: Tensor = self.value(scene[:, None] + self.push(pushes))
        return value.squeeze(-1)


class Twins(nn.Module):
    """Two critics, of which the lower value counts (Fujimoto et al. 2018).

    Their weights are stacked, so that both are computed in one call.
    """

    def __init__(self, corners: int, width: int) -> None:
        super().__init__()
        both, _ = stack_module_state([Critic(corners, width) for _ in range(2)])
        self._names = list(both)
        self.weights = nn.ParameterList(both.values())
        with torch.device("meta"):
            self._form = [Critic(corners, width)]  # in a list: not a submodule

    def forward(self, seen: Seen, pushes: Tensor) -> Tensor:
        """Values (2, n, N) of pushes (n, N, 22) by both critics."""
        values: Tensor = vmap(lambda *own: self._value(own, seen, pushes))(*self.weights)
        return values

    def one(self, which: int, seen: Seen, pushes: Tensor) -> Tensor:
        """Values (n, N) of pushes (n, N, 22) by one critic."""
        return self._value([both[which] for both in self.weights], seen, pushes)

    def _value(self, weights: Sequence[Tensor], seen: Seen, pushes: Tensor) -> Tensor:
        own = dict(zip(self._names, weights, strict=True))
        values: Tensor = functional_call(self._form[0], own, (seen, pushes))
        return values


class Alone(nn.Module):
    """Model of the motion of a pushed token that touches no other, averaged over friction."""

    def __init__(self, corners: int, width: int) -> None:
        super().__init__()
        self.layers = perceptron(2 * corners + 4, (width, width), 3, norm=True)

    def forward(self, outlines: Tensor, begins: Tensor, ends: Tensor) -> Tensor:
        """Motions (..., 3) of outlines (..., C, 2) by pushes (..., 2), in the tokens' frames."""
        parts = outlines.flatten(-2) * 3.0, begins * 4.0, (ends - begins) * 4.0
        moved: Tensor = self.layers(torch.cat(parts, dim=-1)) * _FAR
        return moved


class Table(nn.Module):
    """Stored results of `Alone` for the fixed set of pushes."""

    def __init__(self, tokens: int) -> None:
        super().__init__()
        self.moved = nn.Parameter(torch.zeros(tokens, PUSHES, 3), requires_grad=False)

    @torch.no_grad()
    def renew(self, alone: Alone, tokens: Tokens) -> None:
        """Recompute the table with the present network."""
        outlines = tokens.outlines[:, None].expand(*tokens.begins.shape[:2], -1, -1)
        self.moved.copy_(alone(outlines, tokens.begins, tokens.ends))


def _ended(width: int) -> tuple[nn.Module, nn.Module]:
    return nn.LayerNorm(width), nn.ReLU()
