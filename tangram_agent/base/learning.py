"""What all learners by gradients share: networks with their averages, optimisers and state."""

import copy
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.base.adam import Adam
from tangram_agent.base.config import LearningConfig
from tangram_agent.nets.networks import initialise, parameter_count
from tangram_agent.nets.weights import load_arrays, to_arrays, under
from tangram_core.agent import Learner, NotFiniteError, Tensors
from tangram_core.errors import RunError
from tangram_core.spec import Array

_COUNTER = "updates"


class Rates(NamedTuple):
    """Learning rates of an update, and how much the running average keeps; tensors where traced."""

    actor: float | Tensor
    critic: float | Tensor
    kept: float | Tensor


class NetworkLearner(Learner):
    """Networks, their targets, optimisers and the running average that is played with.

    Attributes:
        parts: networks by the names under which a checkpoint has them.
        playing: what is played with.
        acting: its running average, of which workers get what they need.
        optimisers: of the networks that learn, by their names in `parts`.
    """

    advice = "lower agent.critic_lr"

    def __init__(
        self,
        config: LearningConfig,
        learned: Mapping[str, nn.Module],
        playing: nn.Module,
        seed: int,
        device: str,
    ) -> None:
        """Networks with the weights of a seed.

        Args:
            config: rates and averages.
            learned: networks that are learned by gradients, by name.
            playing: what is played with, made of these.
            seed: of the weights.
            device: where it learns.
        """
        generator = torch.Generator().manual_seed(seed)
        for network in learned.values():
            initialise(network, generator)
        self._rates_of = config
        self.place = torch.device(device)
        self.device, self.updates = device, 0
        self.parameters = parameter_count(*learned.values())
        playing.to(self.place)
        for network in learned.values():
            network.to(self.place)
        self.playing, self.acting = playing, frozen(playing)
        self.parts: dict[str, nn.Module] = {**learned, **self._more_parts(), "acting": self.acting}
        # Kept as lists: walking the modules takes a fifth of a small network's update.
        self._lists = self.parameter_lists()
        self.optimisers = {part: Adam(self._lists[part]) for part in learned}

    def _more_parts(self) -> dict[str, nn.Module]:
        """Networks that no gradient reaches: targets, and others that are fitted otherwise."""
        return {}

    def parameter_lists(self) -> dict[str, list[Tensor]]:
        """Parameters by the names of `parts`, and those of `playing`."""
        modules = self.parts | {"playing": self.playing}
        return {name: list(module.parameters()) for name, module in modules.items()}

    # Steps

    def _step(self, part: str, loss: Tensor, rate: float | Tensor) -> Tensor:
        """One step of one network, whatever else the loss depends on; its gradient's norm."""
        gradients = torch.autograd.grad(loss, self._lists[part])
        norm = gradient_norm(gradients, traced=isinstance(rate, Tensor))
        self.optimisers[part].step(gradients, rate)
        return norm

    def _counted(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        """The numbers of an update, which now counts: the one wait for the device, at its end.

        Raises:
            NotFiniteError: one is not finite.
        """
        numbers = dict(zip(values, torch.stack(list(values.values())).tolist(), strict=True))
        check_finite(self.updates + 1, numbers)
        self.updates += 1
        return numbers

    def rate_factor(self, share: float) -> float:
        """By which learning rates have fallen at a used share of the budget: along a cosine."""
        used, low = min(max(share, 0.0), 1.0), self._rates_of.lr_final
        return low + (1.0 - low) * 0.5 * (1.0 + math.cos(math.pi * used))

    def rates(self, share: float) -> Rates:
        """Of the next update, at a used share of the budget."""
        rate = self._rates_of.critic_lr * self.rate_factor(share)
        return Rates(rate, rate, average_so_far(self._rates_of.acting_average, self.updates))

    def changed_by_update(self) -> list[Tensor]:
        """All that an update by gradients changes."""
        parameters = [one for own in self.parts.values() for one in own.parameters()]
        every = self.optimisers.values()
        kept = [one for each in every for own in each.slots.values() for one in own]
        return parameters + kept

    # State

    def export(self) -> Tensors:
        """A copy of the weights to play with, as a checkpoint keeps them."""
        return to_arrays(self.acting)

    def broadcast(self) -> Tensors:
        """Those of them that workers need."""
        return self.export()

    def state(self) -> dict[str, Array]:
        """Everything but the replay that the next update depends on."""
        state: dict[str, Array] = {_COUNTER: np.array([self.updates], np.int64)}
        for part, module in self.parts.items():
            for name, value in to_arrays(module).items():
                state[f"{part}.{name}"] = value
        for part, optimiser in self.optimisers.items():
            state |= saved_slots(part, optimiser.slots)
        return state

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state from `state()`.

        Raises:
            RunError: tensors are missing or have other shapes: another layout or another net.
        """
        if _COUNTER not in state:
            raise RunError("learner state: no counter of updates: not a learner's checkpoint")
        self.load_networks(state)
        for part, optimiser in self.optimisers.items():
            optimiser.load(read_slots(part, state, self.place))
        self.updates = int(state[_COUNTER][0])

    def load_networks(self, state: Mapping[str, Array]) -> None:
        """Take over the networks of a state, and nothing else.

        Raises:
            RunError: tensors are missing or have other shapes.
        """
        for part, module in self.parts.items():
            load_arrays(module, under(f"{part}.", state))

    def begin_with(self, state: Mapping[str, Array]) -> None:
        """Take over the networks of another run."""
        self.load_networks(state)

    @abstractmethod
    def memory(self) -> dict[str, Array]:
        """See `Learner.memory`."""


def saved_slots(part: str, slots: Mapping[str, list[Tensor]]) -> dict[str, Array]:
    """What an optimiser keeps, by the names of a checkpoint."""
    return {
        f"{part}_optimiser.{i}.{name}": tensor.cpu().numpy().copy()
        for name, tensors in slots.items()
        for i, tensor in enumerate(tensors)
    }


def read_slots(
    part: str, state: Mapping[str, Array], device: torch.device
) -> dict[str, list[Tensor]]:
    """What an optimiser kept, from a checkpoint."""
    content: dict[str, dict[int, Tensor]] = {}
    for key, value in under(f"{part}_optimiser.", state).items():
        i, name = key.split(".", 1)
        content.setdefault(name, {})[int(i)] = torch.from_numpy(np.array(value)).to(device)
    return {n: [one[i] for i in sorted(one)] for n, one in content.items()}


def frozen(module: nn.Module) -> nn.Module:
    """A copy that no gradient reaches."""
    return copy.deepcopy(module).requires_grad_(False)


def polyak_update(targets: list[Tensor], sources: list[Tensor], rho: float | Tensor) -> None:
    """Eq. 4: target <- rho * target + (1 - rho) * source, parameter by parameter."""
    with torch.no_grad():
        if isinstance(rho, Tensor):  # the update is traced
            for target, source in zip(targets, sources, strict=True):
                target.lerp_(source, 1.0 - rho)
        else:
            torch._foreach_lerp_(targets, sources, 1.0 - rho)


def gradient_norm(gradients: Sequence[Tensor], traced: bool) -> Tensor:
    """The norm of all gradients together, ().

    torch's own is one kernel for all of them, which compiled code cannot call directly: what is
    traced is told in single operations.
    """
    if not traced:
        return nn.utils.get_total_norm(gradients)
    return torch.stack([one.square().sum() for one in gradients]).sum().sqrt()


def average_so_far(rho: float, updates: int) -> float:
    """Rho of a running average after `updates` updates: smaller at first, to forget the start.

    A constant 0.99 holds the random weights of the start for hundreds of updates.
    """
    return min(rho, updates / (updates + 9.0))


def check_finite(updates: int, numbers: Mapping[str, float]) -> None:
    """Raise NotFiniteError unless all numbers of an update are finite."""
    if not all(map(math.isfinite, numbers.values())):
        listed = ", ".join(f"{name}={value:g}" for name, value in numbers.items())
        raise NotFiniteError(f"update {updates} is not finite ({listed})")
