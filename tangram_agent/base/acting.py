"""Base class of actors with a network on the CPU, and the actions made of its outputs."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.nets.weights import load_arrays
from tangram_core.agent import Actor
from tangram_core.arrays import Singles
from tangram_tasks.place import Place


class NetworkActor(Actor):
    """Base class of actors with one network.

    Attributes:
        network: the network whose weights are loaded.
    """

    def __init__(self, network: nn.Module) -> None:
        self.network = network.requires_grad_(False)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters in a broadcast, by name."""
        every = self.network.named_parameters()
        return {name: tuple(p.shape) for name, p in every if self.needs(name)}

    def needs(self, name: str) -> bool:  # noqa: ARG002
        """Whether the parameter of this name is needed to act."""
        return True

    def load(self, weights: Mapping[str, Singles]) -> None:
        """Load the weights of a broadcast, or all weights of a checkpoint."""
        whole = len(weights) > len(self.shapes)
        load_arrays(self.network, weights, None if whole else self.shapes)


def as_actions(token: Tensor, flip: Tensor | None, velocity: Tensor, task: Place) -> Tensor:
    """Actions (B, A) in float32, as in `tangram_sim.motion.actions.make_actions`.

    Args:
        token: (B,) index of the token that moves.
        flip: (B,) 1 where the token is turned over; None: nowhere.
        velocity: (B, 3) in [-1, 1].
        task: defines the entries of an action.
    """
    tokens, parts = task.layout.tokens, list[Tensor]()
    if tokens > 1:
        parts.append((2.0 * token.float() + 1.0) / tokens - 1.0)
    if task.sim.allow_flip:
        flip = torch.zeros_like(token) if flip is None else flip
        parts.append(2.0 * flip.float() - 1.0)
    return torch.cat([*(part[:, None] for part in parts), velocity], dim=1)


def tensor(array: object) -> torch.Tensor:
    """A copy of an array as a float32 tensor; arrays from the network are read-only."""
    return torch.from_numpy(np.array(array, np.float32))
