"""The interface of a task: what is played, what it is worth, and how it is scored.

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
    """What one step of B environments gave.

    Attributes:
        seen: what is observed now: the task's fields, one row for each environment.
        rewards: (B,) for the goal that is played for.
        terminated: (B,) where nothing that follows counts.
    """

    seen: Arrays
    rewards: Floats
    terminated: Bools


@dataclass(frozen=True, eq=False)
class History:
    """What was seen and done in B episodes so far, t steps in each.

    Attributes:
        seen: fields of each moment, (B, t + 1, ...): before each step that was made, and now.
        actions: (B, t, A).
    """

    seen: Arrays
    actions: Singles


# What the fields show now (B rows each), what was before, a generator for each environment ->
# actions (B, A).
Chooser = Callable[[Arrays, History, Generators], Singles]


@dataclass(frozen=True, eq=False)
class Played:
    """E whole episodes, and what only the environments know of them.

    Attributes:
        episodes: as the agent saw them.
        facts: what `Env.facts` told, (E, T + 1, ...): after reset and after each step.
        seconds: (E,) wall time of choosing and moving, an equal share for those played together.
        chose: (E,) processor time of choosing, shared equally by those played together that go on.
    """

    episodes: Episodes
    facts: Arrays
    seconds: Floats = field(default_factory=lambda: np.zeros(0))
    chose: Floats = field(default_factory=lambda: np.zeros(0))


class Env(ABC):
    """B environments that play in step, in one process.

    All randomness of an episode comes from its own generator, so an episode does not depend on
    those beside it. An episode always has `horizon` steps: one that terminates plays on.

    Attributes:
        count: B.
    """

    count: int

    @abstractmethod
    def reset(self, generators: Generators) -> Arrays:
        """Begin an episode in every environment.

        Args:
            generators: B, one for each.

        Returns:
            What is observed: every field of the spec that is one of each moment or episode, (B,
            *shape), of its dtype or a more exact one.
        """

    @abstractmethod
    def step(self, actions: Singles) -> Step:
        """Play one action (B, A) of [-1, 1] in every environment."""

    def facts(self) -> Arrays:
        """What scores are made of and no agent sees, (B, ...) each, now; the same names always."""
        return {}

    def told(self) -> Json:
        """What gymnasium's `info` has of the last step of the first environment."""
        return {}

    def picture(self, size: int) -> Pixels | None:  # noqa: ARG002
        """The first environment as it is now, (size, size, 3); None: there is none."""
        return None

    def close(self) -> None:  # noqa: B027
        """Let go of what it holds; calling it twice does no harm."""


@dataclass(frozen=True)
class Task(ABC):
    """What is played, by any number of workers, and what it is worth.

    A task is a frozen dataclass whose fields are the sections of its settings:

        @dataclass(frozen=True)
        class PointConfig(Settings, section="task"):
            reach: float = setting(0.1, "distance at which the place is reached", low=0)

        @dataclass(frozen=True)
        class Point(Task):
            sections: ClassVar = {"task": PointConfig}
            config: PointConfig = PointConfig()

    The section of its role, `task`, is its `config`; others go by their names.

    The master makes one too, and so does whoever shows a run: to make a task loads no engine.
    `make` does, and only a worker calls it. So nothing heavy is imported at the top of its file.

    What must be there: `spec`, `scores`, `rewards`, `make` and `score`. What may: `check`,
    `check_exact`, `ended`, `rivals`, `draw`, `film` and `plan`.

    **Goals.** Two fields of the spec hold goals of the same shape: what is achieved at each moment,
    and what is desired in an episode. Hindsight asks `rewards` what the same step would have been
    worth for any other goal, so it must be a function of both and nothing else. It is called with
    thousands of rows at a time.

    **Ends.** Every episode has `spec.horizon` steps. Where a task ends early (a place is reached,
    something fell) the step is marked `terminated`, what follows does not count for it, and play
    goes on. A time limit is no end.

    **Scores.** `scores` declares what people are shown; the first one is the headline, by which
    runs are compared. `score` computes them, of played test episodes. Beside a run `rivals` play
    the same tests: what learned nothing, a formula, a rule or a planner; random actions, where a
    task names no other.
    """

    sections: ClassVar[Mapping[str, type[Settings]]] = {}
    agent: ClassVar[str] = "goal"  # who learns it, where a command line names nobody: a preset
    waits: ClassVar[str] = "none so far can be"  # what helps, where no episode can be learned from
    scores: ClassVar[tuple[Score, ...]] = ()

    @property
    @abstractmethod
    def spec(self) -> EpisodeSpec:
        """What its episodes are made of; the same whenever it is asked."""

    @abstractmethod
    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """(n,) what n steps are worth that came to `achieved` (n, ...), for goals (n, ...)."""

    @abstractmethod
    def make(self, count: int, purpose: Purpose = "play") -> Env:
        """So many environments; `test` also tells what scores need and play does not.

        Raises:
            ConfigError: a package that it needs is not installed, or settings that cannot work.
        """

    @abstractmethod
    def score(self, played: Played) -> dict[str, float]:
        """The numbers that `scores` declares, of episodes that were made to test."""

    def ended(self, achieved: Array, desired: Array, recorded: Bools) -> Bools:  # noqa: ARG002
        """(n,) whether n steps terminate for goals (n, ...), where `recorded` did for their own."""
        return recorded

    def check(self, *, plays: bool) -> None:  # noqa: B027
        """Refuse what cannot be played, or with plays=False learned from, on this machine.

        Raises:
            ConfigError: names the setting and the remedy.
        """

    def check_exact(self) -> None:  # noqa: B027
        """Refuse what plays an episode otherwise after another one: lockstep promises the same run.

        Raises:
            ConfigError: names the remedy.
        """

    def rivals(self) -> Mapping[str, Callable[[Env], Chooser]]:
        """What learned nothing, by its name in tables, made for environments that it plays in."""
        size = self.spec.action_size

        def uniform(_seen: Arrays, _past: History, generators: Generators) -> Singles:
            drawn = [one.uniform(-1.0, 1.0, size) for one in generators]
            return np.stack(drawn).astype(np.float32)

        return {"random": lambda _: uniform}

    def draw(self, played: Played) -> Pixels | None:  # noqa: ARG002
        """A picture (H, W, 3) of a few test episodes; None: there is none to be drawn."""
        return None

    def film(self, played: Played) -> Iterable[Pixels] | None:  # noqa: ARG002
        """Pictures (H, W, 3) of test episodes, one after the other; None: there are none."""
        return None

    def plan(self, played: Played) -> Json | None:  # noqa: ARG002
        """The first test episode as data, for a machine that does the same; None: there is none."""
        return None

    def pinned(self) -> Self:
        """With whatever code of the user's own it loads named by its content."""
        return self

    def identity(self) -> Json:
        """Section -> what it says: what master and workers must have alike to play one task."""
        return {n: asdict(getattr(self, "config" if n == "task" else n)) for n in self.sections}

    def facts(self) -> Json:
        """What result.json tells of the task."""
        return {}
