"""What a study is: its plan, and what its runs have left."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from tangram_lab.experiments.report.records import Row


@dataclass(frozen=True)
class Seed:
    """One run of a training.

    Attributes:
        number: the seed.
        state: `finished`, or why there is no result.
        result: content of result.json without the host's name; empty unless it is finished.
        curve: evaluations in the order of training, also of a run that is not finished.
        tests: name of a test -> content of its file.
    """

    number: int
    state: str
    result: Row
    curve: tuple[Row, ...]
    tests: dict[str, Row]

    @property
    def finished(self) -> bool:
        """Whether it trained to its bound."""
        return self.state == "finished"


@dataclass(frozen=True)
class Training:
    """One setting, trained with several seeds.

    Attributes:
        name: in the plan, in folders and files.
        label: for people.
        family: the paper's architecture or another group that it belongs to.
        overrides: arguments of tangram-train.
        after: the training whose networks it began with, or None.
        seeds: every planned one, in the plan's order.
    """

    name: str
    label: str
    family: str
    overrides: tuple[str, ...]
    after: str | None
    seeds: tuple[Seed, ...]

    @property
    def finished(self) -> tuple[Seed, ...]:
        """The seeds that trained to their bound."""
        return tuple(seed for seed in self.seeds if seed.finished)

    @property
    def tokens(self) -> str:
        """The shapes that it plays with, such as `large triangle`; empty while none is finished."""
        names = self.finished[0].result["tokens"] if self.finished else []
        return ", ".join(names).replace("_", " ")

    def values(self, key: str) -> dict[int, float]:
        """Seed -> a number of its result, where there is one."""
        return _numbers((seed.number, seed.result.get(key)) for seed in self.finished)

    def scores(self, test: str, key: str) -> dict[int, float]:
        """Seed -> a score in a test, where there is one."""
        return _numbers((seed.number, seed.tests.get(test, {}).get(key)) for seed in self.finished)

    def each(self, number: Callable[[Seed], float | None]) -> dict[int, float]:
        """Seed -> what a function makes of it, where it makes a number."""
        return _numbers((seed.number, number(seed)) for seed in self.finished)


@dataclass(frozen=True)
class Trial:
    """A test of the plan.

    Attributes:
        label: for people.
        actions: for each token; None as trained.
        corner_noise: standard deviation of the noise on the corners that the agent sees, as a
            share of the arena; None without noise.
    """

    name: str
    label: str
    actions: int | None
    corner_noise: float | None


@dataclass(frozen=True)
class Experiment:
    """A question, and the trainings and tests that answer it.

    Attributes:
        name: in the plan and in the names of files.
        title: for people.
        source: where it stands in the paper, such as `Fig. 4`.
        kind: one of `tangram_lab.experiments.plan.KINDS`.
        note: one or two sentences.
        trainings: in the order to show; a ranking compares with the first.
        tests: in the order to show.
    """

    name: str
    title: str
    source: str
    kind: str
    note: str
    trainings: tuple[Training, ...]
    tests: tuple[Trial, ...]


@dataclass(frozen=True)
class Study:
    """A folder of tangram-experiment that was read.

    Attributes:
        plan: content of plan.json; empty for runs that nobody planned.
        command: that made it.
        commit: of the source tree that planned it, or None.
        budget: name of the budget.
        budget_note: how it differs from the paper's.
        test_episodes: of every test.
        experiments: in the plan's order.
        trainings: in the plan's order.
        tests: in the plan's order.
    """

    plan: Row
    command: str
    commit: str | None
    budget: str
    budget_note: str
    planned_seeds: tuple[int, ...]
    test_episodes: int
    experiments: tuple[Experiment, ...]
    trainings: tuple[Training, ...]
    tests: tuple[Trial, ...]


def _numbers(pairs: Iterable[tuple[int, float | None]]) -> dict[int, float]:
    return {seed: float(value) for seed, value in pairs if value is not None}
