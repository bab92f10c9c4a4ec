"""The interface of an agent: who acts in workers, and who learns in the master.

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
AT_ONCE = 32  # environments that are played at a time where an agent is shown or scored


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights that workers play with.

    Attributes:
        version: number of the broadcast, rising within an epoch.
        tensors: name -> float32 array of the acting network, or of what of it travels.
    """

    version: int
    tensors: Tensors


class NotFiniteError(RunError):
    """Numbers of an update, or weights, that are not finite."""


@dataclass(frozen=True)
class Pace:
    """How much an agent learns from what is played.

    Attributes:
        updates_per_transition: updates for each transition that can be learned from.
        learning_starts: such transitions before the first update.
    """

    updates_per_transition: float
    learning_starts: int


class Actor(ABC):
    """Who acts in a worker: on the CPU, with one thread, for B environments at a time."""

    @property
    @abstractmethod
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Names and shapes of the tensors that `load` takes: what a broadcast must hold."""

    @abstractmethod
    def load(self, weights: Mapping[str, Singles]) -> None:
        """Take over weights, as `Learner.broadcast` gives them.

        Raises:
            RunError: they are of another network.
        """

    @abstractmethod
    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:
        """Actions (B, A) float32 in [-1, 1].

        Args:
            seen: the task's fields of this moment and of the episode, B rows each.
            past: what was seen and done in these episodes before.
            explore: a generator for each environment, where it explores; all that is drawn for an
                environment comes from its own, so that it plays alike whoever plays beside it.
                None: as well as it can.
        """

    def graph(self) -> Any:
        """All of `act` without exploring as one network, for whoever plays it without torch.

        Returns:
            A torch.nn.Module. Its `forward` takes the task's fields by name, (B, *shape) float32,
            and gives actions (B, A).

        Raises:
            ConfigError: it is more than a network, as a search is.
        """
        raise ConfigError(
            f"{type(self).__name__} is more than a network: it searches, or has no graph() of its "
            "own: play it by tangram_agent.runs.load_run, as docs/inference.md has it"
        )


class Learner(ABC):
    """Who learns in the master: networks, optimisers and replay.

    Whatever it draws comes from the generators that it is handed, whose state the master saves: so
    a run that is resumed goes on as if it had never stopped.

    Attributes:
        streams: names of those generators; stream i of a run with a seed is seeded [seed, i].
        advice: what to change where numbers are no longer finite, in an error's words.
        updates: made so far.
        parameters: numbers that are learned.
        device: where, for reports.
        capacity: transitions that are kept, or states, at most.
    """

    streams: tuple[str, ...] = ("replay", "hindsight")
    advice: str = "lower its learning rates"
    updates: int = 0
    parameters: int = 0
    device: str = "cpu"
    capacity: int = 0

    @abstractmethod
    def insert(self, episodes: Episodes, rng: Streams) -> int:
        """Keep what is to be learned from episodes, with whatever hindsight makes of them.

        Returns:
            How many of their transitions can be learned from: the pace counts these.
        """

    @abstractmethod
    def update(self, share: float, rng: Streams) -> dict[str, float]:
        """One update of all networks, from what is kept.

        Args:
            share: of the run's budget that is used, in [0, 1]; 0 where it has none.
            rng: the generators.

        Returns:
            Its numbers, for the curves.

        Raises:
            NotFiniteError: one of them is not finite. The update does not count, and the networks
                may be spoilt: the master loads a state from before.
        """

    @abstractmethod
    def broadcast(self) -> Tensors:
        """What workers need to play: `Actor.load` takes it."""

    @abstractmethod
    def state(self) -> dict[str, Array]:
        """Networks, optimisers and counters: all but the replay that the next update hangs on."""

    @abstractmethod
    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state.

        Raises:
            RunError: it is of another network or task, or not whole.
        """

    @abstractmethod
    def memory(self) -> dict[str, Array]:
        """The replay, for a checkpoint; views will do."""

    @abstractmethod
    def load_memory(self, memory: Mapping[str, Array]) -> None:
        """Take over a replay.

        Raises:
            RunError: it is of another task, or not whole.
        """

    @property
    @abstractmethod
    def kept(self) -> int:
        """Transitions, or states, in the replay."""

    def export(self) -> Tensors:
        """What a finished run is played with; a broadcast may hold less of it."""
        return self.broadcast()

    def begin_with(self, state: Mapping[str, Array]) -> None:
        """Take over what another run learned, in the place of random weights."""
        self.load_state(state)

    def evidence(self) -> Arrays:
        """What the last update learned from, for whoever looks for the cause of a failure."""
        return {}

    def prepare(self) -> None:  # noqa: B027
        """Do ahead of time what the first update would take long for."""


@dataclass(frozen=True)
class Agent(ABC):
    """How a task is learned: settings, and who is made of them.

    An agent is a frozen dataclass whose fields are the sections of its settings, as a task is (see
    `tangram_core.task.Task`):

        @dataclass(frozen=True)
        class TD3(Agent):
            sections: ClassVar = {"agent": TD3Config}
            config: TD3Config = TD3Config()

    To make one loads nothing heavy: `actor` and `learner` import torch when they are called. A
    worker calls `actor`, the master `learner`. They agree on settings by `identity`, and on nothing
    else: what the learner broadcasts, the actor loads.

    What must be there: `pace`, `actor` and `learner`. What may: `check`, `check_training` and
    `facts`.
    """

    sections: ClassVar[Mapping[str, type[Settings]]] = {}

    @property
    @abstractmethod
    def pace(self) -> Pace:
        """How much it learns from what is played."""

    @abstractmethod
    def actor(self, task: Task) -> Actor:
        """Who acts, with weights that are to be loaded."""

    @abstractmethod
    def learner(self, task: Task, seed: int, device: str, *, compiled: bool = False) -> Learner:
        """Who learns, with the weights of a seed.

        Args:
            task: what is played.
            seed: of the weights.
            device: of torch.
            compiled: whether updates are compiled.

        Raises:
            ConfigError: it cannot do it so.
        """

    def check_training(self, *, compiled: bool = False) -> None:  # noqa: B027
        """Refuse settings that are for playing a finished run alone, or to compile what cannot be.

        Raises:
            ConfigError: names the setting.
        """

    def check(self, task: Task) -> None:  # noqa: B027
        """Refuse a task that it cannot play, or settings that would change nothing with it.

        Raises:
            ConfigError: names the setting and the remedy.
        """

    def identity(self) -> Json:
        """Section -> what it says: what master and workers must have alike."""
        return {n: asdict(getattr(self, "config" if n == "agent" else n)) for n in self.sections}

    def facts(self) -> Json:
        """What result.json tells of the agent."""
        return {}
