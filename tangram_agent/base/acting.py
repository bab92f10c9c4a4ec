"""What all actors of networks share: weights on the CPU, and the exploration of one velocity."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.nets.weights import load_arrays
from tangram_core.agent import Actor
from tangram_core.arrays import Singles
from tangram_tasks.place import Place


class NetworkActor(Actor):
    """Acts with a network.

    Attributes:
        network: what the weights are of.
    """

    def __init__(self, network: nn.Module) -> None:
        self.network = network.requires_grad_(False)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of all parameters that a broadcast brings."""
        every = self.network.named_parameters()
        return {name: tuple(p.shape) for name, p in every if self.needs(name)}

    def needs(self, name: str) -> bool:  # noqa: ARG002
        """Whether a parameter is needed to play."""
        return True

    def load(self, weights: Mapping[str, Singles]) -> None:
        """Take over a broadcast, or all weights as a checkpoint keeps them."""
        whole = len(weights) > len(self.shapes)
        load_arrays(self.network, weights, None if whole else self.shapes)


def as_actions(token: Tensor, flip: Tensor | None, velocity: Tensor, task: Place) -> Tensor:
    """Actions (B, A) as `tangram_sim.motion.actions.make_actions` makes them, in single precision.

    Args:
        token: (B,) which one moves.
        flip: (B,) 1 where it is turned over; None: none is.
        velocity: (B, 3) in [-1, 1].
        task: says what an action is made of.
    """
    tokens, parts = task.layout.tokens, list[Tensor]()
    if tokens > 1:
        parts.append((2.0 * token.float() + 1.0) / tokens - 1.0)
    if task.sim.allow_flip:
        flip = torch.zeros_like(token) if flip is None else flip
        parts.append(2.0 * flip.float() - 1.0)
    return torch.cat([*(part[:, None] for part in parts), velocity], dim=1)


def tensor(array: object) -> torch.Tensor:
    """A copy in single precision: arrays that came over the wire are read-only."""
    return torch.from_numpy(np.array(array, np.float32))
