"""The interface of an agent: the actor that plays in workers, the learner in the master.

Legend: E episodes, B environments, T steps of an episode, A entries of an action.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from tangram_core.arrays import Singles
from tangram_core.errors import ConfigError, RunError
from tangram_core.settings import Settings
from tangram_core.spec import Array, Arrays, Episodes
from tangram_core.task import Generators, History, Json, Task

Streams = Mapping[str, np.random.Generator]
Tensors = dict[str, Singles]
AT_ONCE = 32  # environments played at a time when an agent is shown or scored


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights that workers play with.

    Attributes:
        version: number of the broadcast; it rises within an epoch.
        tensors: name -> float32 array, for `Actor.load`.
    """

    version: int
    tensors: Tensors


class NotFiniteError(RunError):
    """Numbers of an update, or weights, are NaN or infinite."""


@dataclass(frozen=True)
class Pace:
    """Number of updates that an agent makes for the transitions that are played.

    Attributes:
        updates_per_transition: updates for each transition that the agent can learn from.
        learning_starts: number of these transitions before the first update.
    """

    updates_per_transition: float
    learning_starts: int


class Actor(ABC):
    """Chooses actions in a worker: on the CPU, in one thread, for B environments at a time."""

    @property
    @abstractmethod
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Names and shapes of the tensors that `load` takes and a broadcast must hold."""

    @abstractmethod
    def load(self, weights: Mapping[str, Singles]) -> None:
        """Load the weights that `Learner.broadcast` returned.

        Raises:
            RunError: the weights belong to another network.
        """

    @abstractmethod
    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:
        """Actions (B, A) float32 in [-1, 1].

        Args:
            seen: the task's fields of this moment and of the episode, B rows each.
            past: earlier observations and actions of the same episodes.
            explore: one generator for each environment, to explore with. All random numbers of an
                environment must come from its own generator, so that its actions do not depend on
                the other environments. None: the best actions, without exploration.
        """

    def graph(self) -> Any:
        """`act` without exploration as one network, to export it for use without torch.

        Returns:
            A torch.nn.Module. Its `forward` takes the task's fields by name, (B, *shape) float32,
            and returns actions (B, A).

        Raises:
            ConfigError: the actor is more than a network, for example a search.
        """
        raise ConfigError(
            f"{type(self).__name__} is more than a network: it searches, or has no graph() of its "
            "own: play it with tangram_agent.runs.load_run, see docs/inference.md"
        )


class Learner(ABC):
    """Learns in the master: networks, optimisers and replay buffer.

    A learner takes all random numbers from the generators that its methods are given. The master
    saves their state, so that a resumed run goes on as if it had never stopped.

    Attributes:
        streams: names of the generators; generator i of a run is seeded with [seed, i].
        advice: remedy in the error that tells of numbers that are no longer finite.
        updates: number of updates so far.
        parameters: number of trainable parameters.
        device: device of the networks, for reports.
        capacity: most transitions, or states, that the replay buffer holds.
    """

    streams: tuple[str, ...] = ("replay", "hindsight")
    advice: str = "lower its learning rates"
    updates: int = 0
    parameters: int = 0
    device: str = "cpu"
    capacity: int = 0

    @abstractmethod
    def insert(self, episodes: Episodes, rng: Streams) -> int:
        """Add episodes to the replay buffer, with the transitions that hindsight adds.

        Returns:
            Number of their transitions that can be learned from; `Pace` counts these.
        """

    @abstractmethod
    def update(self, share: float, rng: Streams) -> dict[str, float]:
        """Update all networks once, from the replay buffer.

        Args:
            share: used share of the run's budget, in [0, 1]; 0 if the run has no budget.
            rng: the generators, by the names in `streams`.

        Returns:
            Losses and other numbers of the update, for the curves.

        Raises:
            NotFiniteError: one of the numbers is not finite. The update does not count. The
                networks may be damaged, so the master loads an earlier state.
        """

    @abstractmethod
    def broadcast(self) -> Tensors:
        """Tensors that workers play with, for `Actor.load`."""

    @abstractmethod
    def state(self) -> dict[str, Array]:
        """Networks, optimisers and counters: all that the next update needs except the replay."""

    @abstractmethod
    def load_state(self, state: Mapping[str, Array]) -> None:
        """Load what `state` returned.

        Raises:
            RunError: the state belongs to another network or task, or is incomplete.
        """

    @abstractmethod
    def memory(self) -> dict[str, Array]:
        """Arrays of the replay buffer, for a checkpoint; views are allowed."""

    @abstractmethod
    def load_memory(self, memory: Mapping[str, Array]) -> None:
        """Load what `memory` returned.

        Raises:
            RunError: the replay buffer belongs to another task, or is incomplete.
        """

    @property
    @abstractmethod
    def kept(self) -> int:
        """Number of transitions, or states, in the replay buffer."""

    def export(self) -> Tensors:
        """Tensors that a finished run is played with; a broadcast may hold fewer."""
        return self.broadcast()

    def begin_with(self, state: Mapping[str, Array]) -> None:
        """Begin with the state of another run instead of random weights."""
        self.load_state(state)

    def evidence(self) -> Arrays:
        """Arrays that the last update learned from, to find the cause of a failure."""
        return {}

    def prepare(self) -> None:  # noqa: B027
        """Do slow work of the first update in advance, such as compiling."""


@dataclass(frozen=True)
class Agent(ABC):
    """A method to learn a task: settings, from which an actor and a learner are made.

    An agent is a frozen dataclass whose fields are the sections of its settings, as a task is (see
    `tangram_core.task.Task`):

        @dataclass(frozen=True)
        class TD3(Agent):
            sections: ClassVar = {"agent": TD3Config}
            config: TD3Config = TD3Config()

    Creating an agent must not load torch: `actor` and `learner` import it when they are called. A
    worker calls `actor`, the master calls `learner`. The two processes compare `identity` only. The
    actor loads what the learner broadcasts.

    A subclass must define `pace`, `actor` and `learner`. It may define `check`, `check_training`
    and `facts`.
    """

    sections: ClassVar[Mapping[str, type[Settings]]] = {}

    @property
    @abstractmethod
    def pace(self) -> Pace:
        """Number of updates that the agent makes for the transitions that are played."""

    @abstractmethod
    def actor(self, task: Task) -> Actor:
        """An actor for the task. Its weights are loaded afterwards."""

    @abstractmethod
    def learner(self, task: Task, seed: int, device: str, *, compiled: bool = False) -> Learner:
        """A learner for the task.

        Args:
            task: the task to learn.
            seed: seed of the initial weights.
            device: the torch device.
            compiled: whether updates are compiled.

        Raises:
            ConfigError: the agent cannot learn with these arguments.
        """

    def check_training(self, *, compiled: bool = False) -> None:  # noqa: B027
        """Refuse settings that are only for playing, and `compiled` if updates cannot be compiled.

        Raises:
            ConfigError: names the setting.
        """

    def check(self, task: Task) -> None:  # noqa: B027
        """Refuse a task that the agent cannot play, or settings without effect on the task.

        Raises:
            ConfigError: names the setting and the remedy.
        """

    def identity(self) -> Json:
        """Section -> its settings, which must be equal in master and workers."""
        return {n: asdict(getattr(self, "config" if n == "agent" else n)) for n in self.sections}

    def facts(self) -> Json:
        """Facts about the agent for result.json."""
        return {}
