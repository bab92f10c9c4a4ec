"""What scores are compared with: policies that learned nothing, and the paper's own numbers."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import yaml

from tangram_lab.experiments.report.numbers import Measure
from tangram_lab.experiments.report.study import Experiment, Row, Study, Training, Trial
from tangram_sim.config import EXACT_SUBSTEPS, UNKNOWN, SimConfig
from tangram_sim.errors import RunError

# Name in the files of tests -> name in the report.
POSITION, EXACT, RANDOM = "position only", "exact oracle", "random"
NAMES = {"position only": POSITION, "exact": EXACT, "random": RANDOM}
# The same where tokens fall short of what they are told, and only some policies learn or know that.
CHANGED = {
    "position only": POSITION,
    "exact": "formula",
    "fitted": "formula with a fitted motion",
    "oracle": "oracle told of the world",
}
# Settings of the simulation that tests set themselves, or that move no token.
APART = ("sim.actions_per_token", "sim.corner_noise", "sim.pixels")

Task = tuple[str, ...]


@dataclass(frozen=True)
class Reference:
    """A policy that learned nothing, at one task.

    Attributes:
        name: as tables show it.
        task: what tells the task from the experiment's others; empty if it has only one.
        by_test: name of a test -> its scores there, the tests that are most like training first.
    """

    name: str
    task: str
    by_test: dict[str, Row]

    @property
    def label(self) -> str:
        """For tables and legends."""
        return f"{self.name} ({self.task})" if self.task else self.name

    def score(self, measure: Measure, test: Trial | None = None) -> float | None:
        """Its score in a test, or in the first that has one."""
        rows = self.by_test.values() if test is None else [self.by_test.get(test.name, {})]
        known = (row[measure.key] for row in rows if row.get(measure.key) is not None)
        return next(map(float, known), None)


def references(study: Study, experiment: Experiment) -> list[Reference]:
    """Every policy that a test of the study has, at every task where tokens do as they are told."""
    return [one for one in _all(study, experiment) if one.by_test]


def references_in_changed_worlds(study: Study, experiment: Experiment) -> list[Reference]:
    """Every policy that a test of the study has, at every task where tokens fall short."""
    return [one for one in _all(study, experiment, changed=True) if one.by_test]


def lacking(study: Study, experiment: Experiment) -> list[str]:
    """The policies that no test of the study has, and for which tasks."""
    tasks: dict[str, list[str]] = {}
    for one in _all(study, experiment):
        if not one.by_test:
            tasks.setdefault(one.name, []).append(one.task)
    names: dict[str, list[str]] = {}
    for name, group in tasks.items():
        names.setdefault("; ".join(filter(None, group)), []).append(name)
    return [", ".join(n) + f" ({group})" * bool(group) for group, n in names.items()]


def position(study: Study, training: Training) -> Reference:
    """The position-only policy at a training's task."""
    return Reference(POSITION, "", _scores(study, POSITION, task_of(training)))


def _all(study: Study, experiment: Experiment, changed: bool = False) -> Iterator[Reference]:
    firsts: dict[Task, Training] = {}
    for one in experiment.trainings:
        if one.finished:
            firsts.setdefault(task_of(one), one)
    shapes = [one.tokens for one in firsts.values()]
    for key, name in (CHANGED if changed else NAMES).items():
        for task, one in firsts.items():
            if any(map(falls_short, task)) == changed:
                label = one.tokens if shapes.count(one.tokens) == 1 else one.label
                yield Reference(name, label * (len(shapes) > 1), _scores(study, key, task))


def _scores(study: Study, key: str, task: Task) -> dict[str, Row]:
    """Name of a test -> what a policy scored there at a task, by the first file that tells it."""
    found: dict[str, Row] = {}
    seeds = [seed for one in study.trainings if task_of(one) == task for seed in one.finished]
    # Without noise, one action.
    for test in sorted(study.tests, key=lambda t: (bool(t.corner_noise), t.actions or 1)):
        for seed in seeds:
            scores = seed.tests.get(test.name, {}).get("baselines", {}).get(key)
            if scores is not None:
                found.setdefault(test.name, scores)
    return found


def falls_short(override: str) -> bool:
    """Whether tokens fall short of what they are told, so that no policy here is an oracle.

    Raises:
        RunError: it cannot be read.
    """
    name, _, value = override.partition("=")
    usual = {f"sim.{one}": getattr(SimConfig, one) for one in UNKNOWN}
    try:
        few = name == "sim.substeps" and int(value) < EXACT_SUBSTEPS
        given = yaml.safe_load(value)
    except (ValueError, yaml.YAMLError):
        raise RunError(f"{override} is no setting: mend the plan of these runs") from None
    given = tuple(given) if isinstance(given, list) else given
    return few or override == "sim=bullet_defaults" or given != usual.get(name, given)


def task_of(training: Training) -> Task:
    """What decides how policies without a network score: shapes, their sizes, the engine."""
    settings = sorted(
        text
        for text in training.overrides
        if text.startswith(("tokens.", "sim.", "sim=")) and text.partition("=")[0] not in APART
    )
    return (training.tokens, *settings)


# Place in the paper -> name of a training or of a family -> what the paper reports: the mean reward
# that it reliably reaches, after so many episodes; parameters, hours and episodes; the mean rewards
# with 1, 2, ... actions in sequence.
VALUES: dict[str, dict[str, Row]] = {
    "Fig. 4": {
        "paper": {"mean_reward": 0.75, "after": 1_500},
        "mlp": {"mean_reward": 0.70, "after": 19_000},
    },
    "Table I": {
        "paper": {"parameters": 504_000, "hours": 72, "episodes": 28_000},
        "mlp": {"parameters": 14_000, "hours": 48, "episodes": 100_000},
    },
    "Table II": {"paper": {"by_actions": (0.758, 0.754, 0.754, 0.764, 0.750)}},
}


def papers(experiment: Experiment, training: Training) -> Row:
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
    return {}


def papers_score(experiment: Experiment, training: Training, trial: Trial) -> float | None:
    """The paper's mean reward in a test without noise, by its count of actions."""
    if trial.corner_noise or trial.actions is None:
        return None
    told: Sequence[float] = papers(experiment, training).get("by_actions", ())
    return next((value for count, value in enumerate(told, 1) if count == trial.actions), None)
