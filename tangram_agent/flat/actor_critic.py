"""What learners with an actor and critics share: all but their networks and losses.

Legend: B transitions, F entries of a row, A entries of an action, N draws.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.base.adam import Adam
from tangram_agent.base.compiling import Compiled
from tangram_agent.base.learning import (
    check_finite,
    frozen,
    gradient_norm,
    read_slots,
    saved_slots,
)
from tangram_agent.flat.agent import ActorCriticAgent
from tangram_agent.flat.config import BaseConfig
from tangram_agent.flat.inputs import Inputs, Normaliser
from tangram_agent.flat.playing import MEAN, POLICY, SCALE
from tangram_agent.flat.replay import EpisodeReplay
from tangram_agent.nets.weights import load_arrays, to_arrays, under
from tangram_core.agent import Learner, Streams, Tensors
from tangram_core.errors import ConfigError, RunError
from tangram_core.spec import Array, Arrays, Episodes
from tangram_core.task import Task

Config = TypeVar("Config", bound=BaseConfig)
_COUNTER = "updates"


@dataclass(frozen=True, eq=False)
class Batch:
    """What the losses see, on the device.

    Attributes:
        rows: (B, F) where the action was taken; the goal is in them.
        actions: (B, A).
        rewards: (B,).
        goes_on: (B,) 1 where what follows counts, 0 where the step terminated.
        following: (B, F) what the action came to.
        normals: (N, B, A) drawn from a standard normal: losses draw nothing themselves, so that
            they can be compiled, and a run that is resumed goes on exactly.
        acts: whether this update moves the actor.
    """

    rows: Tensor
    actions: Tensor
    rewards: Tensor
    goes_on: Tensor
    following: Tensor
    normals: Tensor
    acts: bool = field(default=True, kw_only=True)


@dataclass(frozen=True, eq=False)
class Loss:
    """What one network is to make small.

    Attributes:
        part: the network's name in `ActorCritic.modules`.
        value: () whatever it depends on, only this network moves.
        told: numbers () for the curves.
    """

    part: str
    value: Tensor
    told: Mapping[str, Tensor] = field(default_factory=dict)


class Rates(NamedTuple):
    """Learning rates of an update; tensors where it is traced."""

    every: float | Tensor


class ActorCritic(Learner, Generic[Config]):
    """Extend it with `modules` and `losses`.

    Attributes:
        draws: N, standard normals that the losses need for each entry of an action.
        delay: the actor moves in every so manieth update.
        config: the agent's settings.
        size, actions: F and A.
        actor: the policy.
        parts: all networks that learn, by name: the actor and `modules`.
        targets: frozen copies of those that `target_names` says, which follow them slowly.
    """

    draws = 1
    delay = 1

    def __init__(
        self,
        agent: ActorCriticAgent,
        task: Task,
        seed: int,
        device: str = "cpu",
        compiled: bool = False,
    ) -> None:
        """Networks with the weights of a seed, and an empty replay."""
        self.config: Config = agent.config  # type: ignore[assignment]  # the agent's own class of it
        self._task, self._inputs = task, Inputs(task.spec)
        self.size, self.actions = self._inputs.size, task.spec.action_size
        self._normaliser = Normaliser(self.size)
        self._replay = EpisodeReplay(task, self.config.replay_capacity)
        self.capacity = self._replay.capacity * task.spec.horizon
        self._device, self.device = torch.device(device), device
        with torch.random.fork_rng(devices=[]):  # what others draw from torch stays as it is
            torch.default_generator.manual_seed(seed)
            self.actor = agent.policy(self.size, self.actions)
            self.parts: dict[str, nn.Module] = {"actor": self.actor, **self.modules()}
        for name, module in self.parts.items():
            if next(module.buffers(), None) is not None:
                raise ConfigError(
                    f"the network {name} has buffers, which no checkpoint would keep: use "
                    "LayerNorm in the place of BatchNorm"
                )
            module.to(self._device)
        self.targets = {name: frozen(self.parts[name]) for name in self.target_names()}
        # Kept as lists: walking the modules takes a fifth of a small network's update.
        self._lists, self._targets = _parameters(self.parts), _parameters(self.targets)
        self.parameters = sum(one.numel() for own in self._lists.values() for one in own)
        self._optimisers = {name: Adam(own) for name, own in self._lists.items()}
        self._names: dict[bool, tuple[str, ...]] = {}
        self._last: Batch | None = None
        self._step: Callable[[Batch, Rates], Tensor] = self.step
        if compiled:
            self._step = Compiled(self.step, self._changed())

    @abstractmethod
    def modules(self) -> dict[str, nn.Module]:
        """New networks besides the actor, by name; torch's generator stands at the seed."""

    @abstractmethod
    def losses(self, batch: Batch) -> Iterator[Loss]:
        """Yield a network's loss; it makes its step before the next one is asked for."""

    def target_names(self) -> tuple[str, ...]:
        """Names of the networks that have a target network."""
        return ("actor", "critic")

    def bounded(self, values: Tensor) -> Tensor:
        """Values (B,) within what the task's rewards can add up to: r / (1 - gamma)."""
        if not self.config.clip_targets:
            return values
        least, most = self._task.spec.rewards
        whole = 1.0 - self.config.gamma
        return values.clamp(min(least, 0.0) / whole, max(most, 0.0) / whole)

    @property
    def kept(self) -> int:
        """Transitions in the replay."""
        return len(self._replay) * self._task.spec.horizon

    def insert(self, episodes: Episodes, rng: Streams) -> int:  # noqa: ARG002
        """Keep whole episodes: goals are relabelled when a batch is drawn."""
        self._normaliser.add(self._inputs.of_episodes(episodes))
        self._replay.add(episodes)
        return episodes.transitions

    def update(self, share: float, rng: Streams) -> dict[str, float]:  # noqa: ARG002
        """One update of all networks; the learning rate stays as it is."""
        self._last = batch = self.batch(rng)
        found = self._step(batch, Rates(self.config.learning_rate))
        numbers = dict(zip(self._names[batch.acts], found.tolist(), strict=True))
        check_finite(self.updates + 1, numbers)
        self.updates += 1
        return numbers

    def batch(self, rng: Streams) -> Batch:
        """What the next update learns from: all that is random in it is drawn here."""
        found = self._replay.sample(self.config, rng)
        shape = (self.draws, *found.actions.shape)
        return self._on_device(
            self._normaliser(self._inputs.rows(found.before)),
            found.actions,
            found.rewards,
            1.0 - found.terminated,
            self._normaliser(self._inputs.rows(found.after)),
            rng["replay"].standard_normal(shape, np.float32),
        )

    def step(self, batch: Batch, rates: Rates) -> Tensor:
        """The whole update, on the device alone; its numbers, by the names in `_names`."""
        numbers: dict[str, Tensor] = {}
        for loss in self.losses(batch):
            gradients = torch.autograd.grad(loss.value, self._lists[loss.part])
            norm = gradient_norm(gradients, traced=isinstance(rates.every, Tensor))
            self._optimisers[loss.part].step(gradients, rates.every)
            own = {f"{loss.part}_loss": loss.value, f"{loss.part}_gradient": norm}
            numbers |= own | dict(loss.told)
        with torch.no_grad():
            for name, target in self._targets.items():
                torch._foreach_lerp_(target, self._lists[name], 1.0 - self.config.polyak)
        self._names[batch.acts] = tuple(numbers)
        return torch.stack([one.detach() for one in numbers.values()])

    def prepare(self) -> None:
        """Compile what is to be compiled."""
        if not isinstance(self._step, Compiled):
            return
        count, size, actions = self.config.batch_size, self.size, self.actions
        shapes = (count, size), (count, actions), (count,), (count,), (count, size)
        normals = (self.draws, count, actions)
        blank = [np.zeros(shape, np.float32) for shape in (*shapes, normals)]
        batch = self._on_device(*blank)
        for acts in (True, False)[: self.delay]:
            self._step.prepare(replace(batch, acts=acts), Rates(self.config.learning_rate))

    def broadcast(self) -> Tensors:
        """The policy, and the statistics of what it sees."""
        policy = {POLICY + name: value for name, value in to_arrays(self.actor).items()}
        return {MEAN: self._normaliser.mean, SCALE: self._normaliser.scale, **policy}

    def state(self) -> dict[str, Array]:
        """Networks, target networks, optimisers, statistics and the counter."""
        state: dict[str, Array] = {_COUNTER: np.array([self.updates], np.int64)}
        for part, module in self._modules().items():
            state |= {f"{part}.{name}": value for name, value in to_arrays(module).items()}
        for part, optimiser in self._optimisers.items():
            state |= saved_slots(part, optimiser.slots)
        return state | {f"seen.{name}": value for name, value in self._normaliser.state().items()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        if _COUNTER not in state:
            raise RunError("learner state: no counter of updates: not a learner's checkpoint")
        self.begin_with(state)
        for part, optimiser in self._optimisers.items():
            optimiser.load(read_slots(part, state, self._device))
        self.updates = int(state[_COUNTER][0])

    def begin_with(self, state: Mapping[str, Array]) -> None:
        """Take over networks and statistics, and learn on with new optimisers."""
        for part, module in self._modules().items():
            load_arrays(module, under(f"{part}.", dict(state)))
        self._normaliser.load_state(under("seen.", dict(state)))

    def memory(self) -> dict[str, Array]:
        """The replay."""
        return self._replay.state()

    def load_memory(self, memory: Mapping[str, Array]) -> None:
        """Take over a replay."""
        self._replay.load_state(memory)

    def evidence(self) -> Arrays:
        """The last batch, as the networks saw it."""
        if self._last is None:
            return {}
        names = "rows", "actions", "rewards", "goes_on", "following"
        return {name: getattr(self._last, name).cpu().numpy() for name in names}

    def _modules(self) -> dict[str, nn.Module]:
        """All networks, by the names under which a checkpoint has them."""
        return self.parts | {f"target_{name}": module for name, module in self.targets.items()}

    def _changed(self) -> list[Tensor]:
        """All that an update changes."""
        every: list[Sequence[Tensor]] = [*self._lists.values(), *self._targets.values()]
        every += [own for each in self._optimisers.values() for own in each.slots.values()]
        return [one for own in every for one in own]

    def _on_device(self, *arrays: Array) -> Batch:
        parts = (self._tensor(np.asarray(one, np.float32)) for one in arrays)
        return Batch(*parts, acts=self.updates % self.delay == 0)

    def _tensor(self, array: Array) -> Tensor:
        return torch.from_numpy(np.array(array)).to(self._device)


def _parameters(modules: Mapping[str, nn.Module]) -> dict[str, list[Tensor]]:
    return {name: list(module.parameters()) for name, module in modules.items()}
