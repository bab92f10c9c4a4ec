"""Policies to compare with, as tests of the same task scored them on the same episodes."""

from collections.abc import Sequence
from dataclasses import dataclass

from tangram_lab.experiments.report.markdown import Measure
from tangram_lab.experiments.report.records import Row
from tangram_lab.experiments.report.study import Experiment, Study, Training, Trial

# Name in the files of tests -> name in the report.
POSITION, PERFECT, RANDOM = "position only", "perfect", "random"
NAMES = {"position only": POSITION, "exact": PERFECT, "random": RANDOM}
# Settings of the simulation that tests set themselves, or that move no token.
APART = ("sim.actions_per_token", "sim.corner_noise", "sim.camera", "sim.pixels", "sim.max_tries")

# Where tokens fall short of what they are told, no policy here is an oracle.
INEXACT = "sim.inexact=true"

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

    def score(self, tests: Sequence[Trial], measure: Measure) -> float | None:
        """Its score in the first of the tests that has one."""
        found = [self.by_test[one.name] for one in tests if one.name in self.by_test]
        values = [row[measure.key] for row in found if row.get(measure.key) is not None]
        return float(values[0]) if values else None


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
            if INEXACT not in task
        ]

    def position(self, training: Training, measure: Measure) -> float | None:
        """What the position-only policy scores at a training's task."""
        known = self._scores.get((POSITION, task_of(training)), {})
        return Reference(POSITION, "", known).score(self.plain, measure)


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
    known = [one for one in experiment.trainings if one.finished]
    firsts = {task_of(one): one for one in reversed(known)}
    tasks = list(dict.fromkeys(map(task_of, known)))
    if len(tasks) == 1:
        return {tasks[0]: ""}
    shapes = [firsts[task].tokens for task in tasks]
    return {
        task: shape if shapes.count(shape) == 1 else firsts[task].label
        for task, shape in zip(tasks, shapes, strict=True)
    }
