"""Base classes of gradient learners: networks, target networks, optimisers and state."""

import copy
import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.base.adam import Adam
from tangram_agent.base.compiling import Whole
from tangram_agent.base.config import LearningConfig
from tangram_agent.nets.networks import initialise, parameter_count
from tangram_agent.nets.weights import load_arrays, to_arrays, under
from tangram_core.agent import Learner, NotFiniteError, Streams, Tensors
from tangram_core.errors import ConfigError, RunError
from tangram_core.spec import Array, Arrays

_COUNTER = "updates"


class Rates(NamedTuple):
    """Learning rates of an update, and rho of the running average; tensors inside a graph."""

    actor: float | Tensor
    critic: float | Tensor
    kept: float | Tensor


@dataclass(frozen=True, eq=False)
class Loss:
    """The loss of one network.

    Attributes:
        part: the network's name in `NetworkLearner.parts`.
        value: () the loss; its gradient changes only this network.
        told: further numbers () for the curves, by name.
    """

    part: str
    value: Tensor
    told: Mapping[str, Tensor] = field(default_factory=dict)


class Ahead(NamedTuple):
    """What an update was given before its turn: its batch, and the generators' states before."""

    seen: Any
    batch: Any
    rng: Streams
    states: dict[str, Any]


class Replay(Protocol):
    """A replay buffer that a checkpoint can save and load."""

    def __len__(self) -> int: ...
    def state(self) -> dict[str, Array]: ...  # noqa: D102
    def load_state(self, state: Mapping[str, Array]) -> None: ...  # noqa: D102


class NetworkLearner(Learner):
    """Learner of networks by their losses, with target networks that follow slowly.

    Attributes:
        polyak: rho of the target networks, Eq. 4.
        delay: updates for each update of the actor.
        compiles: whether updates may become graphs, by the compiler or on a GPU.
        replay: the replay buffer.
        batch: the batch of the last update; it has `arrays`.
        targets: target networks, by the names of the networks that they follow.
        parts: all networks, by their names in a checkpoint.
        lists: parameters of each network: collecting them takes a fifth of a small update.
        optimisers: optimisers of the learned networks, by their names in `parts`.
        names: names of an update's numbers: True with a step of the actor, False without.
        draws_ahead: whether a batch is drawn while the device computes the update before it.
    """

    compiles = True
    delay = 1
    polyak: float
    replay: Replay
    batch: Any = None

    def __init__(
        self,
        learned: Mapping[str, nn.Module],
        targets: Iterable[str],
        device: str,
        *,
        compiled: bool = False,
        others: Mapping[str, nn.Module] | None = None,
    ) -> None:
        """Take networks with their present weights.

        Args:
            learned: networks that are learned by gradients, by name.
            targets: names of learned networks that have a target network.
            device: torch device for learning.
            compiled: whether an update is compiled as a whole, see `Whole`; on a GPU it is
                recorded in any case.
            others: networks that change in other ways than by gradients, by name.
        """
        for name in targets:
            if name not in learned:
                self.refuse("target_names", f"'{name}'", f"names of {', '.join(learned)}")
        self.targets = {name: frozen(learned[name]) for name in targets}
        following = {f"target_{name}": module for name, module in self.targets.items()}
        self.parts: dict[str, nn.Module] = {**learned, **following, **(others or {})}
        self.place, self.device = torch.device(device), device
        for module in self.parts.values():
            module.to(self.place)
        self.parameters = parameter_count(*learned.values())
        self.lists: dict[str, list[Tensor]] = {
            n: [*one.parameters()] for n, one in self.parts.items()
        }
        self.optimisers = {name: Adam(self.lists[name]) for name in learned}
        self.names: dict[bool, tuple[str, ...]] = {}
        self.draws_ahead = self.place.type == "cuda"
        self._ahead: Ahead | None = None
        self._whole: Callable[[Any, Rates], Tensor] = self.step
        self._traced = compiled
        if self.compiles and (compiled or self.place.type == "cuda"):
            slots = [own for each in self.optimisers.values() for own in each.slots.values()]
            changed = [one for own in (*self.lists.values(), *slots) for one in own]
            self._whole = Whole(self.step, changed, compiled)

    # For subclasses

    @abstractmethod
    def drawn(self, rng: Streams) -> Any:
        """Draw the batch of an update for `losses`; all random numbers are drawn here."""

    @abstractmethod
    def losses(self, seen: Any) -> Iterator[Loss]:
        """Yield each network's loss; the network makes its step before the next is computed."""

    @abstractmethod
    def rates(self, share: float) -> Rates:
        """Rates of the next update, at a used share of the budget."""

    def blanks(self) -> Iterator[Any]:
        """Example batches to compile for, one of each form that `losses` may get."""
        yield from ()

    def follow(self, rates: Rates) -> None:  # noqa: ARG002
        """Move target networks a little towards their networks, Eq. 4."""
        for name in self.targets:
            polyak_update(self.lists[f"target_{name}"], self.lists[name], self.polyak)

    # Updates

    def update(self, share: float, rng: Streams) -> dict[str, float]:
        """See `Learner.update`; the numbers are those of `learn`."""
        if self._ahead is None:
            seen = self.drawn(rng)
        else:
            seen, self.batch, self._ahead = self._ahead.seen, self._ahead.batch, None
        return self.learn(seen, share, rng if self.draws_ahead else None)

    def learn(self, seen: Any, share: float = 0.0, rng: Streams | None = None) -> dict[str, float]:
        """Make one step of all networks.

        Args:
            seen: a batch from `drawn`.
            share: used share of the run's budget, in [0, 1]; sets the learning rates.
            rng: generators to draw the next batch with, while the device computes; None: do not.

        Returns:
            NAME_loss and NAME_gradient (the norm) of each network, and what its loss told.

        Raises:
            NotFiniteError: one of the numbers is not finite.
        """
        found = self._whole(seen, self.rates(share))  # only tolist() below waits for it
        names = self.names[getattr(seen, "acts", True)]
        self.updates += 1
        if rng is not None:
            batch, states = self.batch, {name: g.bit_generator.state for name, g in rng.items()}
            following = self.drawn(rng)
            self._ahead, self.batch = Ahead(following, self.batch, rng, states), batch
        numbers = dict(zip(names, found.tolist(), strict=True))
        if not all(map(math.isfinite, numbers.values())):
            self.put_back()
            self.updates -= 1
            listed = ", ".join(f"{name}={value:g}" for name, value in numbers.items())
            raise NotFiniteError(f"update {self.updates + 1} is not finite ({listed})")
        return numbers

    def put_back(self) -> None:
        """Undo a drawing ahead, generators included: so it changes no number of a run.

        It comes before each change of the replay buffer, and before a state is saved or loaded.
        """
        if self._ahead is not None:
            for name, generator in self._ahead.rng.items():
                generator.bit_generator.state = self._ahead.states[name]
            self._ahead = None

    def step(self, seen: Any, rates: Rates) -> Tensor:
        """Make the whole update on the device; returns its numbers in the order of `names`."""
        numbers: dict[str, Tensor] = {}
        for loss in self.losses(seen):
            self._check(loss)
            rate = rates.actor if loss.part == "actor" else rates.critic
            gradients = torch.autograd.grad(loss.value, self.lists[loss.part])
            norm = gradient_norm(gradients, self._traced)
            self.optimisers[loss.part].step(gradients, rate, self._traced)
            own = {f"{loss.part}_loss": loss.value, f"{loss.part}_gradient": norm}
            numbers |= own | dict(loss.told)
        self.follow(rates)
        self.names[getattr(seen, "acts", True)] = tuple(numbers)
        return torch.stack([one.detach() for one in numbers.values()])

    def _check(self, loss: Loss) -> None:
        """Refuse a loss of an unknown network, or a value that is not a single number."""
        if loss.part not in self.optimisers:
            known = ", ".join(self.optimisers)
            self.refuse("losses", f"a Loss of '{loss.part}'", f"one of {known}")
        for name, value in {f"a Loss of '{loss.part}'": loss.value, **loss.told}.items():
            if value.ndim:
                self.refuse("losses", f"{name} of shape {tuple(value.shape)}", "a single number")

    def refuse(self, method: str, came: str, wanted: str) -> NoReturn:
        """Raise ConfigError for a wrong result of a subclass's method."""
        raise ConfigError(f"{type(self).__name__}.{method}: wanted {wanted}, got {came}")

    def prepare(self) -> None:
        """Make the graphs of updates ahead of time: to compile them may take a minute."""
        if isinstance(self._whole, Whole):
            for seen in self.blanks():
                self._whole.prepare(seen, self.rates(0.0))
                self._check_steady(self._whole, seen)

    def _check_steady(self, whole: Whole, seen: Any) -> None:
        """Refuse losses that depend on the number of updates: a graph would keep the first one."""
        made, rates, numbers = self.updates, self.rates(0.0), list[Tensor]()
        for self.updates in (made, made + 10**6):
            with whole.unchanged():
                numbers.append(self.step(seen, rates))
        self.updates = made
        if not torch.allclose(numbers[0], numbers[1], rtol=1e-2, atol=1e-5, equal_nan=True):
            wanted = "equal losses of equal batches, which a GPU or a compiler can repeat"
            came = "other losses after more updates: move what changes to drawn(), or set compiles"
            self.refuse("losses", f"{came} = False in the class", wanted)

    def tensor(self, array: Array, dtype: type = np.float32) -> Tensor:
        """A tensor of an array, on the device."""
        made = torch.from_numpy(np.asarray(array, dtype))
        if self.place.type == "cuda":  # from pageable memory it would wait for the last update
            made = made.pin_memory()
        return made.to(self.place, non_blocking=True)

    # State

    @property
    def kept(self) -> int:
        """Number of entries in the replay buffer."""
        return len(self.replay)

    def memory(self) -> dict[str, Array]:
        """The replay buffer, for a checkpoint."""
        return self.replay.state()

    def load_memory(self, memory: Mapping[str, Array]) -> None:
        """Load a replay buffer from a checkpoint."""
        self.replay.load_state(memory)

    def evidence(self) -> Arrays:
        """Arrays of the last update's batch, by name."""
        return {} if self.batch is None else self.batch.arrays

    def state(self) -> dict[str, Array]:
        """Networks, optimisers and the number of updates, for a checkpoint."""
        self.put_back()
        state: dict[str, Array] = {_COUNTER: np.array([self.updates], np.int64)}
        for part, module in self.parts.items():
            state |= {f"{part}.{name}": value for name, value in to_arrays(module).items()}
        for part, optimiser in self.optimisers.items():
            for name, tensors in optimiser.slots.items():
                for i, tensor in enumerate(tensors):
                    state[f"{part}_optimiser.{i}.{name}"] = tensor.cpu().numpy().copy()
        return state

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Load a state from `state()`.

        Raises:
            RunError: tensors are missing or have other shapes: another layout or another net.
        """
        if _COUNTER not in state:
            raise RunError("the learner's state has no number of updates: take another checkpoint")
        self.load_networks(state)
        for part, optimiser in self.optimisers.items():
            content: dict[str, dict[int, Tensor]] = {}
            for key, value in under(f"{part}_optimiser.", state).items():
                i, name = key.split(".", 1)
                content.setdefault(name, {})[int(i)] = torch.from_numpy(np.array(value))
            slots = {n: [own[i].to(self.place) for i in sorted(own)] for n, own in content.items()}
            optimiser.load(slots)
        self.updates = int(state[_COUNTER][0])

    def load_networks(self, state: Mapping[str, Array]) -> None:
        """Load only the networks of a state.

        Raises:
            RunError: tensors are missing or have other shapes.
        """
        self.put_back()
        for part, module in self.parts.items():
            load_arrays(module, under(f"{part}.", state))

    def begin_with(self, state: Mapping[str, Array]) -> None:
        """Load the networks of another run; the optimisers start anew."""
        self.load_networks(state)


class TokenLearner(NetworkLearner):
    """Learner of an agent of tokens, which plays with a running average of its networks.

    Attributes:
        acting: the running average, which workers get.
    """

    advice = "lower agent.critic_lr"

    def __init__(
        self,
        config: LearningConfig,
        learned: Mapping[str, nn.Module],
        playing: nn.Module,
        seed: int,
        device: str,
        *,
        targets: Iterable[str] = (),
        compiled: bool = False,
    ) -> None:
        """Initialise the networks from a seed.

        Args:
            config: settings of learning rates and averages.
            learned: see `NetworkLearner`, also for arguments that are not listed here.
            playing: the network that plays, made of learned networks; `acting` averages it.
            seed: seed of the weights.
            device: torch device for learning.
        """
        generator = torch.Generator().manual_seed(seed)
        for network in learned.values():
            initialise(network, generator)
        self._rates_of, self.capacity = config, config.replay_capacity
        self.acting = frozen(playing)
        others = {"acting": self.acting}
        super().__init__(learned, targets, device, compiled=compiled, others=others)
        self.lists["playing"] = list(playing.parameters())

    def follow(self, rates: Rates) -> None:
        """Update the target networks and the running average."""
        super().follow(rates)
        polyak_update(self.lists["acting"], self.lists["playing"], rates.kept)

    def rate_factor(self, share: float) -> float:
        """Factor of the learning rates at a used share of the budget; it falls along a cosine."""
        used, low = min(max(share, 0.0), 1.0), self._rates_of.lr_final
        return low + (1.0 - low) * 0.5 * (1.0 + math.cos(math.pi * used))

    def rates(self, share: float) -> Rates:
        """Rates of the next update, at a used share of the budget."""
        rate = self._rates_of.critic_lr * self.rate_factor(share)
        # A constant 0.99 would keep the random first weights for hundreds of updates.
        kept = min(self._rates_of.acting_average, self.updates / (self.updates + 9.0))
        return Rates(rate, rate, kept)

    def export(self) -> Tensors:
        """A copy of the averaged weights, for a checkpoint."""
        return to_arrays(self.acting)

    def broadcast(self) -> Tensors:
        """The averaged weights that workers need."""
        return self.export()


def frozen(module: nn.Module) -> nn.Module:
    """A copy of a module whose parameters need no gradients."""
    return copy.deepcopy(module).requires_grad_(False)


def polyak_update(targets: list[Tensor], sources: list[Tensor], rho: float | Tensor) -> None:
    """Eq. 4: target <- rho * target + (1 - rho) * source, parameter by parameter."""
    with torch.no_grad():
        if isinstance(rho, Tensor):  # inside a graph
            for target, source in zip(targets, sources, strict=True):
                target.lerp_(source, 1.0 - rho)
        else:
            torch._foreach_lerp_(targets, sources, 1.0 - rho)


def gradient_norm(gradients: Sequence[Tensor], traced: bool) -> Tensor:
    """The norm of all gradients together, ().

    torch's own norm is one kernel, which compiled code cannot call directly. A traced update uses
    single operations instead.
    """
    if not traced:
        return nn.utils.get_total_norm(gradients)
    return torch.stack([one.square().sum() for one in gradients]).sum().sqrt()
