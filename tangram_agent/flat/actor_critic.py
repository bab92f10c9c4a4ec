"""Base class of learners with an actor and critics: all but their networks and losses.

Legend: B transitions, F entries of a row, A entries of an action, N draws.
"""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.base.learning import Loss, NetworkLearner, Rates
from tangram_agent.flat.agent import ActorCriticAgent
from tangram_agent.flat.config import BaseConfig
from tangram_agent.flat.inputs import Inputs, Normaliser, normalised
from tangram_agent.flat.playing import MEAN, POLICY, SCALE
from tangram_agent.flat.replay import EpisodeReplay
from tangram_agent.nets.weights import to_arrays, under
from tangram_core.agent import Streams, Tensors
from tangram_core.errors import ConfigError
from tangram_core.spec import Array, Arrays, Episodes
from tangram_core.task import Task

__all__ = ["ActorCritic", "Batch", "Loss"]
Config = TypeVar("Config", bound=BaseConfig)


@dataclass(frozen=True, eq=False)
class Batch:
    """A batch for the losses, on the device.

    Attributes:
        rows: (B, F) inputs before the action, the goal included.
        actions: (B, A).
        rewards: (B,).
        goes_on: (B,) 0 where the step terminated, else 1.
        following: (B, F) inputs after the action, the goal included.
        normals: (N, B, A) standard normals. Losses must draw nothing themselves: so they can be
            compiled, and a resumed run goes on exactly.
        acts: whether this update changes the actor.
    """

    rows: Tensor
    actions: Tensor
    rewards: Tensor
    goes_on: Tensor
    following: Tensor
    normals: Tensor
    acts: bool = field(default=True, kw_only=True)

    @property
    def arrays(self) -> Arrays:
        """The arrays of the batch, by name."""
        tensors = {name: one for name, one in vars(self).items() if isinstance(one, Tensor)}
        return {name: one.cpu().numpy() for name, one in tensors.items()}


class ActorCritic(NetworkLearner, Generic[Config]):
    """Learner of an actor and critics; a subclass adds `modules` and `losses`.

    Attributes:
        draws: N, standard normals that the losses need for each entry of an action.
        config: the agent's settings.
        size, actions: F and A.
        actor: the policy.
    """

    draws = 1
    replay: EpisodeReplay

    def __init__(
        self,
        agent: ActorCriticAgent,
        task: Task,
        seed: int,
        device: str = "cpu",
        compiled: bool = False,
    ) -> None:
        """Initialise the networks from a seed and make an empty replay buffer."""
        self.config: Config = agent.config  # type: ignore[assignment]  # the agent's own class of it
        self.polyak = self.config.polyak
        self._task, self._inputs = task, Inputs(task.spec)
        self.size, self.actions = self._inputs.size, task.spec.action_size
        self._normaliser = Normaliser(self.size)
        self.replay = EpisodeReplay(task, self.config.replay_capacity, torch.device(device))
        self.capacity = self.replay.capacity * task.spec.horizon
        with torch.random.fork_rng(devices=[]):  # leaves torch's global generator unchanged
            torch.default_generator.manual_seed(seed)
            self.actor = agent.policy(self.size, self.actions)
            learned: dict[str, nn.Module] = {"actor": self.actor, **self.modules()}
        for name, module in learned.items():
            if next(module.buffers(), None) is not None:
                raise ConfigError(
                    f"the network {name} has buffers, which checkpoints do not keep: use "
                    "LayerNorm instead of BatchNorm"
                )
        super().__init__(learned, self.target_names(), device, compiled=compiled)
        self._settle()

    @abstractmethod
    def modules(self) -> dict[str, nn.Module]:
        """New networks besides the actor, by name; torch's generator is seeded before the call."""

    @abstractmethod
    def losses(self, batch: Batch) -> Iterator[Loss]:
        """Yield each network's loss; the network makes its step before the next is computed."""

    def target_names(self) -> tuple[str, ...]:
        """Names of the networks that have a target network."""
        return ("actor", "critic")

    def bounded(self, values: Tensor) -> Tensor:
        """Values (B,), clamped to the possible discounted sums of rewards: r / (1 - gamma)."""
        least, most = self._task.spec.rewards
        whole = 1.0 - self.config.gamma
        return values.clamp(min(least, 0.0) / whole, max(most, 0.0) / whole)

    @property
    def kept(self) -> int:
        """Number of transitions in the replay buffer."""
        return len(self.replay) * self._task.spec.horizon

    def insert(self, episodes: Episodes, rng: Streams) -> int:  # noqa: ARG002
        """Add whole episodes; their goals are relabelled when a batch is drawn."""
        self.put_back()
        self._normaliser.add(self._inputs.of_episodes(episodes))
        self._settle()
        self.replay.add(episodes)
        return episodes.transitions

    def rates(self, share: float) -> Rates:  # noqa: ARG002
        """The same constant learning rate for all networks."""
        return Rates(self.config.learning_rate, self.config.learning_rate, 0.0)

    def learn(self, seen: Any, share: float = 0.0, rng: Streams | None = None) -> dict[str, float]:
        """See `NetworkLearner.learn`; refuse losses that leave a network out."""
        numbers = super().learn(seen, share, rng)
        if len(self.names) == min(self.delay, 2):  # each form of an update was made
            found = {name for names in self.names.values() for name in names}
            for name in self.optimisers:
                if f"{name}_loss" not in found:
                    self.refuse("losses", f"none of '{name}'", "a Loss of each network that learns")
        return numbers

    def drawn(self, rng: Streams) -> Batch:
        """Draw the batch of an update, with all its random numbers.

        Transitions and goals are drawn on the CPU; the observations of episodes are already on the
        device.
        """
        found = self.replay.sample(self.config, rng)
        rows, steps = self.tensor(found.rows, np.int64), self.tensor(found.steps, np.int64)
        desired = self.tensor(found.desired)
        shape = (self.draws, self.config.batch_size, self.actions)
        self.batch = batch = self._batch(
            self._rows(self.replay.seen(rows, steps, desired)),
            self.replay.actions(rows, steps),
            self.tensor(found.rewards),
            self.tensor(1.0 - found.terminated),
            self._rows(self.replay.seen(rows, steps + 1, desired)),
            self.tensor(rng["replay"].standard_normal(shape, np.float32)),
        )
        return batch

    def blanks(self) -> Iterator[Batch]:
        """Example batches to compile for: with an update of the actor, and without."""
        count, size, actions = self.config.batch_size, self.size, self.actions
        shapes = (count, size), (count, actions), (count,), (count,), (count, size)
        normals = (self.draws, count, actions)
        blank = self._batch(*(torch.zeros(shape).to(self.place) for shape in (*shapes, normals)))
        for moves in (True, False)[: self.delay]:
            yield replace(blank, acts=moves)

    def _batch(self, *parts: Tensor) -> Batch:
        return Batch(*parts, acts=self.updates % self.delay == 0)

    def _rows(self, seen: Mapping[str, Tensor]) -> Tensor:
        """Normalised network inputs (B, F) of fields with B rows each."""
        count = self.config.batch_size
        parts = [seen[name].reshape(count, -1) for name in self._inputs.names]
        rows: Tensor = normalised(torch.cat(parts, dim=1), self._mean, self._scale)
        return rows

    def _settle(self) -> None:
        """Copy the input statistics to the device."""
        self._mean = self.tensor(self._normaliser.mean)
        self._scale = self.tensor(self._normaliser.scale)

    def broadcast(self) -> Tensors:
        """The policy and the statistics of its inputs."""
        policy = {POLICY + name: value for name, value in to_arrays(self.actor).items()}
        return {MEAN: self._normaliser.mean, SCALE: self._normaliser.scale, **policy}

    def state(self) -> dict[str, Array]:
        """Networks, optimisers and the running statistics of the inputs, for a checkpoint."""
        seen = {f"seen.{name}": value for name, value in self._normaliser.state().items()}
        return super().state() | seen

    def load_networks(self, state: Mapping[str, Array]) -> None:
        """Load the networks and the statistics of the inputs."""
        super().load_networks(state)
        self._normaliser.load_state(under("seen.", state))
        self._settle()
