"""What scores are compared with: policies that learned nothing, and the paper's own numbers."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from tangram_lab.experiments.report.numbers import Measure
from tangram_lab.experiments.report.study import Experiment, Row, Study, Training, Trial
from tangram_sim.config import EXACT_SUBSTEPS

# Name in the files of tests -> name in the report.
POSITION, PERFECT, RANDOM = "position only", "perfect", "random"
NAMES = {"position only": POSITION, "exact": PERFECT, "random": RANDOM}
# Settings of the simulation that tests set themselves, or that move no token.
APART = ("sim.actions_per_token", "sim.corner_noise", "sim.pixels")

Task = tuple[str, ...]


@dataclass(frozen=True)
class Reference:
    """A policy that learned nothing, at one task.

    Attributes:
        name: position only, perfect or random.
        task: what tells the task from the experiment's others; empty if it has only one.
        by_test: name of a test -> its scores there.
    """

    name: str
    task: str
    by_test: dict[str, Row]

    @property
    def label(self) -> str:
        """For tables and legends."""
        return f"{self.name} ({self.task})" if self.task else self.name

    def score(self, tests: Iterable[Trial], measure: Measure) -> float | None:
        """Its score in the first of the tests that has one."""
        rows = (self.by_test.get(one.name, {}) for one in tests)
        values = (row[measure.key] for row in rows if row.get(measure.key) is not None)
        return next(map(float, values), None)


class References:
    """All that the tests of a study know of such policies.

    Attributes:
        plain: the tests of the study, those most like training first: without noise, one action.
    """

    def __init__(self, study: Study) -> None:
        self.plain = sorted(study.tests, key=lambda t: (bool(t.corner_noise), t.actions or 1))
        self._scores: dict[tuple[str, Task], dict[str, Row]] = {}
        for training in study.trainings:
            for seed in training.finished:
                for test, row in seed.tests.items():
                    for key, scores in row.get("baselines", {}).items():
                        by_test = self._scores.setdefault((key, task_of(training)), {})
                        by_test.setdefault(test, scores)

    def of(self, experiment: Experiment) -> list[Reference]:
        """Every known policy at every task of an experiment."""
        return [one for one in self._all(experiment) if one.by_test]

    def lacking(self, experiment: Experiment) -> list[str]:
        """The policies that no test of the study has, and for which tasks."""
        tasks: dict[str, list[str]] = {}
        for one in self._all(experiment):
            if not one.by_test:
                tasks.setdefault(one.name, []).append(one.task)
        names: dict[str, list[str]] = {}
        for name, group in tasks.items():
            names.setdefault("; ".join(filter(None, group)), []).append(name)
        return [", ".join(n) + f" ({group})" * bool(group) for group, n in names.items()]

    def _all(self, experiment: Experiment) -> list[Reference]:
        return [
            Reference(name, label, self._scores.get((key, task), {}))
            for key, name in NAMES.items()
            for task, label in _tasks(experiment).items()
            if not any(map(_falls_short, task))
        ]

    def position(self, training: Training, measure: Measure) -> float | None:
        """What the position-only policy scores at a training's task."""
        known = self._scores.get((POSITION, task_of(training)), {})
        return Reference(POSITION, "", known).score(self.plain, measure)


def _falls_short(override: str) -> bool:
    """Whether tokens fall short of what they are told, so that no policy here is an oracle."""
    name, _, value = override.partition("=")
    few = name == "sim.substeps" and int(value) < EXACT_SUBSTEPS
    return few or (name == "sim.damping" and float(value) > 0.0)


def task_of(training: Training) -> Task:
    """What decides how policies without a network score: shapes, their sizes, the engine."""
    settings = sorted(
        text
        for text in training.overrides
        if text.startswith(("tokens.", "sim.")) and text.partition("=")[0] not in APART
    )
    return (training.tokens, *settings)


def _tasks(experiment: Experiment) -> dict[Task, str]:
    """Every task of an experiment, and what tells it from the others."""
    firsts: dict[Task, Training] = {}
    for one in experiment.trainings:
        if one.finished:
            firsts.setdefault(task_of(one), one)
    shapes = [one.tokens for one in firsts.values()]
    if len(shapes) == 1:
        return dict.fromkeys(firsts, "")
    return {
        task: one.tokens if shapes.count(one.tokens) == 1 else one.label
        for task, one in firsts.items()
    }


@dataclass(frozen=True)
class Value:
    """What the paper reports of one of its agents.

    Attributes:
        mean_reward: that it reliably reaches.
        after: episodes until then.
        parameters: of the network.
        hours: of training.
        episodes: of training.
        by_actions: mean rewards with 1, 2, ... actions in sequence.
    """

    mean_reward: float | None = None
    after: int | None = None
    parameters: int | None = None
    hours: float | None = None
    episodes: int | None = None
    by_actions: Sequence[float] = ()


# Place in the paper -> name of a training or of a family -> what the paper reports.
VALUES = {
    "Fig. 4": {
        "paper": Value(mean_reward=0.75, after=1_500),
        "mlp": Value(mean_reward=0.70, after=19_000),
    },
    "Table I": {
        "paper": Value(parameters=504_000, hours=72, episodes=28_000),
        "mlp": Value(parameters=14_000, hours=48, episodes=100_000),
    },
    "Table II": {"paper": Value(by_actions=(0.758, 0.754, 0.754, 0.764, 0.750))},
}


def papers(experiment: Experiment, training: Training) -> Value | None:
    """The paper's numbers for a training of an experiment, by the place that this names.

    They belong to the training of that very name; where an experiment has none, to its family.
    """
    names = {one.name for one in experiment.trainings}
    for place, known in VALUES.items():
        if re.search(rf"{re.escape(place)}(?!\w)", experiment.source):
            if training.name in known:
                return known[training.name]
            if training.family in known and training.family not in names:
                return known[training.family]
    return None


def papers_score(experiment: Experiment, training: Training, trial: Trial) -> float | None:
    """The paper's mean reward in a test without noise, by its count of actions."""
    known = papers(experiment, training)
    if known is None or trial.corner_noise or trial.actions is None:
        return None
    return dict(enumerate(known.by_actions, 1)).get(trial.actions)
