"""What a study is: experiments, the trainings and tests that answer them, and what there is."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec

from tangram_lab.experiments.fingerprints import Fingerprint
from tangram_lab.experiments.plan import TestConfig, TrainingConfig
from tangram_sim.errors import RunError

Row = dict[str, Any]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]

FINISHED = "finished"
SETTINGS = ("sim", "agent")  # of a test; the plan has those that it asked for


@dataclass(frozen=True)
class Seed:
    """One run of a training.

    Attributes:
        number: the seed.
        state: `finished`, or why there is no result.
        result: content of result.json without the host's name; empty unless there is one.
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
        return self.state == FINISHED


@dataclass(frozen=True)
class Training(TrainingConfig):
    """One setting with its name in folders and files, and every planned seed in the plan's order.

    Its overrides are all arguments of tangram-train, its settings what they came to.
    """

    name: str = ""
    settings: Row = field(default_factory=dict)
    seeds: tuple[Seed, ...] = ()

    @property
    def finished(self) -> tuple[Seed, ...]:
        """The seeds that trained to their bound."""
        return tuple(seed for seed in self.seeds if seed.finished)

    @property
    def tokens(self) -> str:
        """The shapes that it plays with, such as `large triangle`; empty while none is finished."""
        names = self.finished[0].result["tokens"] if self.finished else []
        return ", ".join(names).replace("_", " ")

    def values(self, key: str, test: str | None = None) -> dict[int, float]:
        """Seed -> a number of its result, or its score in a test, where there is one."""
        if test is None:
            return self.each(lambda seed: seed.result.get(key))
        return self.each(lambda seed: seed.tests.get(test, {}).get(key))

    def compared(self, policy: str, key: str, test: str) -> dict[int, float]:
        """Seed -> what a policy that its test compares it with scored, where there is one."""
        return self.each(
            lambda seed: seed.tests.get(test, {}).get("baselines", {}).get(policy, {}).get(key)
        )

    def each(self, number: Callable[[Seed], float | None]) -> dict[int, float]:
        """Seed -> what a function makes of it, where it makes a number."""
        pairs = ((seed.number, number(seed)) for seed in self.finished)
        return {seed: float(value) for seed, value in pairs if value is not None}


@dataclass(frozen=True)
class Trial(TestConfig):
    """A test with its name in the plan and of its files."""

    name: str = ""

    def asked(self, setting: str) -> float | None:
        """A number that it asks of tangram-eval, of a list the first; None as trained.

        Raises:
            RunError: something else stands there.
        """
        told = {text.partition("=")[0]: text.partition("=")[2] for text in self.overrides}
        try:
            first = told[setting].strip("[]").partition(",")[0] if setting in told else None
            return None if first is None else float(first)
        except ValueError:
            raise RunError(
                f"test {self.name}: {setting} must be a number, got '{told[setting]}': mend "
                "plan.json"
            ) from None

    @property
    def actions(self) -> float | None:
        """For each token."""
        return self.asked("sim.actions_per_token")

    @property
    def corner_noise(self) -> float | None:
        """Deviation of the noise on the corners that the agent sees, in arenas."""
        return self.asked("sim.corner_noise")


@dataclass(frozen=True)
class Experiment:
    """A question, and the trainings and tests that answer it; a ranking compares with the first."""

    name: str
    title: str
    source: str
    kind: str
    note: str
    trainings: tuple[Training, ...]
    tests: tuple[Trial, ...]

    @property
    def main_test(self) -> str | None:
        """The test whose scores are shown where one is; None of runs that nobody planned."""
        return self.tests[0].name if self.tests else None


@dataclass(frozen=True)
class Budget:
    """Its name, how it differs from the paper's, and what it plans for every training and test."""

    name: str
    note: str
    test_episodes: Count = 0
    test_seed: Count = 0


@dataclass(frozen=True)
class Study:
    """A folder of tangram-experiment that was read.

    Attributes:
        plan: content of plan.json; empty for runs that nobody planned.
        command: that made it.
        commit: of the source tree that planned it, or None.
        fingerprints: training -> of the code that trained it.
    """

    plan: Row
    command: str
    commit: str | None
    budget: Budget
    experiments: tuple[Experiment, ...]
    trainings: tuple[Training, ...]
    tests: tuple[Trial, ...]
    fingerprints: dict[str, Fingerprint]
