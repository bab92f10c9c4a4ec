"""The tables of several tokens: what was covered, how exactly, and what the order matters."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from tangram_lab.experiments.report.markdown import (
    ANGLE,
    MINUTES,
    NOTHING,
    POSITION,
    Measure,
    plain,
    table,
)
from tangram_lab.experiments.report.records import Row
from tangram_lab.experiments.report.study import Experiment, Training, Trial

COVERAGE = Measure("coverage", "coverage", "covered share of the target", "{:.4f}")
SOLVED = Measure("share_solved", "solved", "targets covered by 0.95 or more (%)", "{:.1f} %", 100)
IOU = Measure("iou", "IoU", "intersection over union", "{:.3f}")
WRONG = Measure("wrong", "wrong pieces", "wrong pieces per target", "{:.2f}")
DOUBLE = Measure("doubly_used", "doubly used", "pieces used twice per target", "{:.2f}")
BLOCKED = Measure("blocked", "refused placements", "refused placements per target", "{:.2f}")
TIME = Measure("seconds_per_puzzle", "ms per target", "time per target (ms)", "{:,.0f}", 1000)
MEASURES = (COVERAGE, SOLVED, IOU, POSITION, ANGLE, WRONG, DOUBLE, BLOCKED, TIME)
EACH = "coverage_each"  # of a test's file: the coverage of every episode
ORDERS = ("order=listed", "order=size", "order=random")
# Two-sided 95 % of a normal distribution: there are a hundred pairs and more.
NORMAL = 1.96


def assembly_table(experiment: Experiment) -> list[str]:
    """Scores of every training in every test, and of policies that learned nothing."""
    head = ["training", "test", "seeds", *(one.label for one in MEASURES), MINUTES.label]
    rows = [
        [
            one.label,
            test.label,
            str(len(one.scores(test.name, COVERAGE.key))),
            *(measure.show_spread(one.scores(test.name, measure.key)) for measure in MEASURES),
            MINUTES.show_spread(one.values(MINUTES.key)),
        ]
        for one in experiment.trainings
        for test in experiment.tests
    ]
    return table(head, [*rows, *_plain_rows(experiment)])


def _plain_rows(experiment: Experiment) -> Iterator[list[str]]:
    """What the perfect hand and chance reach, once for each task."""
    seen = set[tuple[str, str]]()
    for one in experiment.trainings:
        for test in experiment.tests:
            task = (one.tokens, test.label)
            if task in seen or not one.scores(test.name, COVERAGE.key):
                continue
            seen.add(task)
            for name in ("exact", "random"):
                values = [_baseline(one, test, name, measure) for measure in MEASURES]
                yield [name, f"{test.label}, {_count(one)}", "", *values, ""]


def order_table(experiment: Experiment) -> list[str]:
    """Learned order less each fixed one: mean of the paired differences, 95 % interval.

    Pairs are the same episode played by the same weights; an episode's difference is averaged over
    the seeds first, so that pairs are independent.
    """
    head = ["training", "test", "learned", *(f"less {name}" for name in ORDERS)]
    rows = []
    for one in experiment.trainings:
        for test in experiment.tests:
            learned = one.scores(test.name, COVERAGE.key)
            shown = [paired(differences(one, test, name)) for name in ORDERS]
            if any(text != NOTHING for text in shown):
                rows.append([one.label, test.label, COVERAGE.show_spread(learned), *shown])
    return [plain(ORDER_NOTE), "", *table(head, rows)] if rows else []


ORDER_NOTE = (
    "The learned order less a fixed one, on the same starts and targets with the same weights: "
    "mean difference of the coverage and its 95 % interval over the episodes, each averaged over "
    "the seeds."
)


def differences(training: Training, test: Trial, order: str) -> np.ndarray:
    """(E,) coverage with the learned order less that with another, averaged over the seeds."""
    each = []
    for seed in training.finished:
        content = seed.tests.get(test.name, {})
        own, other = content.get(EACH), content.get("baselines", {}).get(order, {}).get(EACH)
        if own is not None and other is not None and len(own) == len(other):
            each.append(np.subtract(own, other))
    return np.mean(each, axis=0) if each else np.zeros(0)


def paired(values: Sequence[float] | np.ndarray) -> str:
    """Mean and 95 % interval of independent differences; `-` of fewer than two."""
    if len(values) < 2:
        return NOTHING
    mean = float(np.mean(values))
    half = NORMAL * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return f"{mean:+.4f} ({mean - half:+.4f} to {mean + half:+.4f})"


def _baseline(training: Training, test: Trial, name: str, measure: Measure) -> str:
    """A score of a policy that learned nothing, the same for every seed."""
    for seed in training.finished:
        baselines: Mapping[str, Row] = seed.tests.get(test.name, {}).get("baselines", {})
        found = baselines.get(name, {})
        if measure.key in found:
            return measure.show(found[measure.key])
    return NOTHING


def _count(training: Training) -> str:
    count = len(training.finished[0].result["tokens"])
    return f"{count} tokens"
