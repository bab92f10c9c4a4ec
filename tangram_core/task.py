"""The interface of a task: environments, rewards and scores.

Legend: E episodes, B environments, T steps of an episode, A entries of an action, n goals.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal, Self

import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels, Singles
from tangram_core.scores import Score
from tangram_core.settings import Settings
from tangram_core.spec import Array, Arrays, Episodes, EpisodeSpec

Generators = Sequence[np.random.Generator]
Purpose = Literal["play", "test"]
Json = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Step:
    """The result of one step of B environments.

    Attributes:
        seen: observations after the step: the task's fields, one row for each environment.
        rewards: (B,) rewards for the desired goal.
        terminated: (B,) true if the task ended with this step.
    """

    seen: Arrays
    rewards: Floats
    terminated: Bools


@dataclass(frozen=True, eq=False)
class History:
    """Observations and actions of the first t steps of B episodes.

    Attributes:
        seen: fields of each moment, (B, t + 1, ...): before each of the t steps, and now.
        actions: (B, t, A).
    """

    seen: Arrays
    actions: Singles


# Present fields (B rows each), history, a generator for each environment -> actions (B, A).
Chooser = Callable[[Arrays, History, Generators], Singles]


@dataclass(frozen=True, eq=False)
class Played:
    """E whole episodes, with facts of the environments that no agent sees.

    Attributes:
        episodes: the episodes as the agent saw them.
        facts: results of `Env.facts`, (E, T + 1, ...): after reset and after each step.
        seconds: (E,) wall time in s of choosing and stepping; episodes played together share it.
        chose: (E,) processor time in s of choosing; unfinished episodes played together share it.
    """

    episodes: Episodes
    facts: Arrays
    seconds: Floats = field(default_factory=lambda: np.zeros(0))
    chose: Floats = field(default_factory=lambda: np.zeros(0))


class Env(ABC):
    """B environments in one process that are stepped together.

    All randomness of an episode comes from its own generator, so an episode does not depend on the
    other environments. An episode always has `horizon` steps, also after it terminated.

    Attributes:
        count: B, the number of environments.
    """

    count: int

    @abstractmethod
    def reset(self, generators: Generators) -> Arrays:
        """Begin an episode in every environment.

        Args:
            generators: B random generators, one for each environment.

        Returns:
            Observations: the fields of the spec per moment or per episode, (B, *shape), in their
            dtypes or more exact ones.
        """

    @abstractmethod
    def step(self, actions: Singles) -> Step:
        """Play one action in every environment; actions (B, A) lie in [-1, 1]."""

    def facts(self) -> Arrays:
        """Name -> current values (B, ...) for scores; no agent sees them. Names never change."""
        return {}

    def told(self) -> Json:
        """Entries of gymnasium's `info` for the last step of the first environment."""
        return {}

    def picture(self, size: int) -> Pixels | None:  # noqa: ARG002
        """A picture (size, size, 3) of the first environment now; None: there is none."""
        return None

    def close(self) -> None:  # noqa: B027
        """Free all resources; a second call does nothing."""


@dataclass(frozen=True)
class Task(ABC):
    """A task: environments that any number of workers play, their rewards and scores.

    A task is a frozen dataclass whose fields are the sections of its settings:

        @dataclass(frozen=True)
        class PointConfig(Settings, section="task"):
            reach: float = setting(0.1, "distance at which the place is reached", low=0)

        @dataclass(frozen=True)
        class Point(Task):
            sections: ClassVar = {"task": PointConfig}
            config: PointConfig = PointConfig()

    The field `config` holds the section `task`; other fields have the names of their sections.

    The master and the commands that show a run create tasks, too. So creating a task must not load
    an engine, and the file must not import one at its top. Only `make` loads it, in a worker.

    A subclass must define `spec`, `scores`, `rewards`, `make` and `score`. It may define `check`,
    `check_exact`, `ended`, `rivals`, `draw`, `film` and `plan`.

    **Goals.** Two fields of the spec hold goals of the same shape: the achieved goal of each moment
    and the desired goal of the episode. Hindsight calls `rewards` to get the reward of a step for
    another goal, so `rewards` must depend on these two fields only. It is called with thousands of
    rows at a time.

    **Ends.** Every episode has `spec.horizon` steps. If a task ends early (a place is reached,
    something fell), the step is marked `terminated`. Play goes on, but later steps do not count for
    this step. A time limit is no end.

    **Scores.** `scores` declares the numbers that people are shown. The first one is the headline,
    by which runs are compared. `score` computes them from played test episodes. `rivals` play the
    same tests for comparison: a formula, a rule or a planner, by default random actions.
    """

    sections: ClassVar[Mapping[str, type[Settings]]] = {}
    agent: ClassVar[str] = "goal"  # preset of the default agent
    waits: ClassVar[str] = "no episode so far can be used"  # shown until one can
    scores: ClassVar[tuple[Score, ...]] = ()

    @property
    @abstractmethod
    def spec(self) -> EpisodeSpec:
        """Names, shapes and bounds of the arrays in an episode; the same at every call."""

    @abstractmethod
    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """Rewards (n,) of n steps that led to `achieved` (n, ...), for goals `desired` (n, ...)."""

    @abstractmethod
    def make(self, count: int, purpose: Purpose = "play") -> Env:
        """Make `count` environments; with purpose `test` they also give the facts for scores.

        Raises:
            ConfigError: a package is not installed, or settings cannot work.
        """

    @abstractmethod
    def score(self, played: Played) -> dict[str, float]:
        """Name -> value of the scores that `scores` declares, from test episodes."""

    def ended(self, achieved: Array, desired: Array, recorded: Bools) -> Bools:  # noqa: ARG002
        """Flags (n,): whether n steps end the task for goals `desired`; `recorded`: as played."""
        return recorded

    def check(self, *, plays: bool) -> None:  # noqa: B027
        """Refuse settings that cannot be played or, with plays=False, learned on this machine.

        Raises:
            ConfigError: names the setting and the remedy.
        """

    def check_exact(self) -> None:  # noqa: B027
        """Refuse, for lockstep, settings with which an episode depends on the one before it.

        Raises:
            ConfigError: names the remedy.
        """

    def rivals(self) -> Mapping[str, Callable[[Env], Chooser]]:
        """Baselines without learning: name in tables -> maker of a `Chooser` for environments."""
        size = self.spec.action_size

        def uniform(_seen: Arrays, _past: History, generators: Generators) -> Singles:
            drawn = [one.uniform(-1.0, 1.0, size) for one in generators]
            return np.stack(drawn).astype(np.float32)

        return {"random": lambda _: uniform}

    def draw(self, played: Played) -> Pixels | None:  # noqa: ARG002
        """A picture (H, W, 3) of a few test episodes; None: the task draws none."""
        return None

    def film(self, played: Played) -> Iterable[Pixels] | None:  # noqa: ARG002
        """Frames (H, W, 3) of an animation of test episodes; None: the task draws none."""
        return None

    def plan(self, played: Played) -> Json | None:  # noqa: ARG002
        """The first test episode as JSON, for a robot that repeats it; None: the task has none."""
        return None

    def pinned(self) -> Self:
        """The same task, with the digest of each file of the user's own code in its settings."""
        return self

    def identity(self) -> Json:
        """Section -> its settings, which must be equal in master and workers."""
        return {n: asdict(getattr(self, "config" if n == "task" else n)) for n in self.sections}

    def facts(self) -> Json:
        """Facts about the task for result.json."""
        return {}
