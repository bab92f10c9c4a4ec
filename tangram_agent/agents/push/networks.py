"""What a push does to a token alone, and what it is worth.

Legend: n rows, F, G numbers of a token and of another one, K tokens, N pushes, W width.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from tangram_agent.agents.push.scenes import PUSHES, Tokens
from tangram_agent.agents.push.seen import PUSH, Seen, other_numbers, token_numbers
from tangram_agent.nets.networks import perceptron, untraced

_FAR = 0.2  # of a token that is pushed


class Critic(nn.Module):
    """Values of pushes: the token and another one, then each push beside them."""

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
        """(n, N) of pushes (n, N, 22)."""
        untraced()
        other = self.others(self.other(seen.other) * seen.there)
        scene = self.scene(self.mixed(self.token(seen.token) + other))
        value: Tensor = self.value(scene[:, None] + self.push(pushes))
        return value.squeeze(-1)


class Twins(nn.Module):
    """Two critics, of which the lesser counts (Fujimoto et al. 2018).

    Their weights lie one behind the other, so both are computed in one go.
    """

    def __init__(self, corners: int, width: int) -> None:
        super().__init__()
        both, _ = stack_module_state([Critic(corners, width) for _ in range(2)])
        self._names = list(both)
        self.weights = nn.ParameterList(both.values())
        with torch.device("meta"):
            self._form = [Critic(corners, width)]  # a list: no part of this module

    def forward(self, seen: Seen, pushes: Tensor) -> Tensor:
        """(2, n, N) of pushes (n, N, 22)."""
        values: Tensor = vmap(lambda *own: self._value(own, seen, pushes))(*self.weights)
        return values

    def one(self, which: int, seen: Seen, pushes: Tensor) -> Tensor:
        """(n, N) of one of them."""
        return self._value([both[which] for both in self.weights], seen, pushes)

    def _value(self, weights: Sequence[Tensor], seen: Seen, pushes: Tensor) -> Tensor:
        own = dict(zip(self._names, weights, strict=True))
        values: Tensor = functional_call(self._form[0], own, (seen, pushes))
        return values


class Alone(nn.Module):
    """Where a token goes that is pushed and touches no other; frictions are averaged over."""

    def __init__(self, corners: int, width: int) -> None:
        super().__init__()
        self.layers = perceptron(2 * corners + 4, (width, width), 3, norm=True)

    def forward(self, outlines: Tensor, begins: Tensor, ends: Tensor) -> Tensor:
        """(..., 3) in its own frame, of its outline (..., C, 2) and the finger's way (..., 2)."""
        parts = outlines.flatten(-2) * 3.0, begins * 4.0, (ends - begins) * 4.0
        moved: Tensor = self.layers(torch.cat(parts, dim=-1)) * _FAR
        return moved


class Table(nn.Module):
    """What `Alone` says of the pushes that are always the same: looked up, not computed."""

    def __init__(self, tokens: int) -> None:
        super().__init__()
        self.moved = nn.Parameter(torch.zeros(tokens, PUSHES, 3), requires_grad=False)

    @torch.no_grad()
    def renew(self, alone: Alone, tokens: Tokens) -> None:
        """As the network has it now."""
        outlines = tokens.outlines[:, None].expand(*tokens.begins.shape[:2], -1, -1)
        self.moved.copy_(alone(outlines, tokens.begins, tokens.ends))


def _ended(width: int) -> tuple[nn.Module, nn.Module]:
    return nn.LayerNorm(width), nn.ReLU()
