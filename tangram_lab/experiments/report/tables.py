"""The tables of each kind of experiment, and the pieces of Markdown that pages are made of."""

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from tangram_lab.experiments.report.numbers import (
    ANGLE,
    EPISODES,
    HOURS,
    MINUTES,
    NOTHING,
    PARAMETERS,
    POSITION,
    REWARD,
    UPDATES,
    Measure,
    first_at_least,
)
from tangram_lab.experiments.report.references import References, Value, papers, papers_score
from tangram_lab.experiments.report.study import Experiment, Row, Training, Trial
from tangram_sim.arrays import Floats

SPREAD = "median (least to most)"
LEVELS = (0.70, 0.75)  # that the paper tells of in Fig. 4
# With several tokens.
COVERAGE = Measure("coverage", "coverage", "covered share of the target", "{:.4f}")
GAME_MEASURES = (
    COVERAGE,
    Measure("share_solved", "solved", "targets covered by 0.95 or more (%)", "{:.1f} %", 100),
    Measure("iou", "IoU", "intersection over union", "{:.3f}"),
    POSITION,
    ANGLE,
    Measure("wrong", "wrong pieces", "wrong pieces per target", "{:.2f}"),
    Measure("doubly_used", "doubly used", "pieces used twice per target", "{:.2f}"),
    Measure("blocked", "refused placements", "refused placements per target", "{:.2f}"),
    Measure("seconds_per_puzzle", "ms per target", "time per target (ms)", "{:,.0f}", 1000),
)
EACH = "coverage_each"  # of a test's file: the coverage of every episode
ORDERS = ("order=listed", "order=size", "order=random")
ORDER_NOTE = (
    "The learned order less a fixed one, on the same starts and targets with the same weights: "
    "mean difference of the coverage and its 95 % interval over the episodes, each averaged over "
    "the seeds."
)
# Two-sided 95 % of a normal distribution: there are a hundred pairs and more.
NORMAL = 1.96


# Markdown


def table(head: Sequence[str], rows: Iterable[Sequence[str]], rest: str = "---:") -> list[str]:
    """A table; the columns after the first are numbers, unless `rest` is `---`."""
    ruler = ["---", *[rest] * (len(head) - 1)]
    escaped = [[plain(cell).replace("|", "\\|") for cell in row] for row in (head, *rows)]
    escaped.insert(1, ruler)
    return [*(f"| {' | '.join(cells)} |" for cells in escaped), ""]


def details(summary: str, lines: Sequence[str]) -> list[str]:
    """Lines that unfold with a click."""
    return ["<details>", f"<summary>{plain(summary)}</summary>", "", *lines, "</details>", ""]


def shell(command: str) -> list[str]:
    """A command to copy."""
    return ["```bash", command, "```", ""]


def plain(text: str) -> str:
    """A text that shows as it stands, in a line of Markdown."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace("\n", " ")


def picture(title: str, file: str) -> list[str]:
    """A figure by its relative path."""
    alternative = plain(title).replace("[", "(").replace("]", ")")
    return [f"![{alternative}]({file})", ""]


# One token


def score_table(
    experiment: Experiment, references: References, measure: Measure, seeds: Sequence[int]
) -> list[str]:
    """Final scores: the paper's, ours over the seeds, every seed, and policies without learning."""
    known = {one.name: papers(experiment, one) for one in experiment.trainings}
    told = {name: value.mean_reward for name, value in known.items() if value is not None}
    beside = measure is REWARD and any(value is not None for value in told.values())
    head = ["training", "seeds", *["paper"] * beside, f"{measure.label}, {SPREAD}"]
    rows = [
        [
            one.label,
            seed_count(one),
            *[_show(told.get(one.name), "{:.2f}")] * beside,
            measure.show_spread(one.values(measure.key)),
            *(measure.show(one.values(measure.key).get(seed)) for seed in seeds),
        ]
        for one in experiment.trainings
    ]
    for reference in references.of(experiment):
        score = measure.show(reference.score(references.plain, measure))
        rows.append([reference.label, "", *[""] * beside, score, *[""] * len(seeds)])
    return table([*head, *(f"seed {seed}" for seed in seeds)], rows)


def effort_table(experiment: Experiment) -> list[str]:
    """How soon the paper's two rewards were reached, the errors at the end, and what it took."""
    known = {one.name: papers(experiment, one) for one in experiment.trainings}
    told = {
        name: f"{value.mean_reward:.2f} after {value.after:,}"
        for name, value in known.items()
        if value is not None and value.mean_reward is not None and value.after is not None
    }
    shown = (ANGLE, POSITION, EPISODES, UPDATES, MINUTES)
    head = ["training", *["paper, episodes"] * bool(told)]
    head += [*(f"{level:.2f} after, episodes" for level in LEVELS), *(m.label for m in shown)]
    rows = (
        [
            one.label,
            *[told.get(one.name, NOTHING)] * bool(told),
            *(_soon(one, level) for level in LEVELS),
            *(measure.show_spread(one.values(measure.key)) for measure in shown),
        ]
        for one in experiment.trainings
    )
    return table(head, rows)


def _soon(training: Training, level: float) -> str:
    """Episodes until a mean reward was first reached, and by how many seeds if not by all."""
    reached = training.each(lambda seed: first_at_least(seed, level))
    few = 0 < len(reached) < len(training.finished)
    count = f", {len(reached)} of {len(training.finished)} seeds" if few else ""
    return EPISODES.show_spread(reached) + count


def complexity_table(experiment: Experiment) -> list[str]:
    """Table I: parameters, time and episodes, the paper's beside ours."""
    head = ["training", "seeds", "paper: parameters", "parameters", "paper: time, h"]
    head += [HOURS.label, "paper: episodes", "episodes", UPDATES.label, REWARD.label]
    rows = []
    for one in experiment.trainings:
        value = papers(experiment, one) or Value()
        parameters, hours, episodes, updates, reward = (
            measure.show_spread(one.values(measure.key))
            for measure in (PARAMETERS, HOURS, EPISODES, UPDATES, REWARD)
        )
        cells = [_show(value.parameters, "{:,}"), parameters, _show(value.hours, "{:g}"), hours]
        cells += [_show(value.episodes, "{:,}"), episodes, updates, reward]
        rows.append([one.label, seed_count(one), *cells])
    return table(head, rows)


def test_table(experiment: Experiment, references: References, measure: Measure) -> list[str]:
    """Rows are trainings, columns are tests; the paper's values and other policies below."""
    tests, rows = experiment.tests, []
    for one in experiment.trainings:
        cells = [measure.show_spread(one.scores(test.name, measure.key)) for test in tests]
        rows.append([one.label, seed_count(one), *cells])
        told = [papers_score(experiment, one, test) for test in tests]
        if measure is REWARD and any(value is not None for value in told):
            rows.append([f"{one.label}, the paper's", "", *map(measure.show, told)])
    for reference in references.of(experiment):
        scores = [reference.score([test], measure) for test in tests]
        if any(score is not None for score in scores):
            rows.append([reference.label, "", *map(measure.show, scores)])
    return table([f"{measure.label}, {SPREAD}", "seeds", *(t.label for t in tests)], rows)


def single_tests(experiment: Experiment, measure: Measure) -> list[str]:
    """Every seed of every training in every test."""
    rows = (
        [
            one.label,
            str(seed.number),
            *(
                measure.show(one.scores(test.name, measure.key).get(seed.number))
                for test in experiment.tests
            ),
        ]
        for one in experiment.trainings
        for seed in one.finished
    )
    return table([measure.label, "seed", *(test.label for test in experiment.tests)], rows)


def ranking_table(
    experiment: Experiment, references: References, seeds: Sequence[int]
) -> list[str]:
    """Every training beside the first: medians and their differences, and every seed."""
    first = experiment.trainings[0]
    head = ["training", "seeds", f"{REWARD.label}, {SPREAD}", "difference"]
    head += [f"{ANGLE.label}, {SPREAD}", "difference", MINUTES.label]
    rows = []
    for one in experiment.trainings:
        cells = [one.label, seed_count(one)]
        for measure in (REWARD, ANGLE):
            values, others = one.values(measure.key), first.values(measure.key)
            apart = "reference" if one is first else measure.show_difference(values, others)
            cells += [measure.show_spread(values), apart]
        rewards = one.values(REWARD.key)
        cells.append(MINUTES.show_spread(one.values(MINUTES.key)))
        rows.append(cells + [REWARD.show(rewards.get(seed)) for seed in seeds])
    for reference in references.of(experiment):
        reward, angle = (m.show(reference.score(references.plain, m)) for m in (REWARD, ANGLE))
        rows.append([reference.label, "", reward, "", angle, "", "", *[""] * len(seeds)])
    return table([*head, *(f"seed {seed}" for seed in seeds)], rows)


def seed_count(training: Training) -> str:
    """How many seeds are finished, of how many."""
    return f"{len(training.finished)} of {len(training.seeds)}"


def _show(value: float | None, pattern: str) -> str:
    return NOTHING if value is None else pattern.format(value)


# Several tokens


def assembly_table(experiment: Experiment) -> list[str]:
    """Scores of every training in every test, and of policies that learned nothing."""
    head = ["training", "test", "seeds", *(one.label for one in GAME_MEASURES), MINUTES.label]
    rows = [
        [
            one.label,
            test.label,
            str(len(one.scores(test.name, COVERAGE.key))),
            *(measure.show_spread(one.scores(test.name, measure.key)) for measure in GAME_MEASURES),
            MINUTES.show_spread(one.values(MINUTES.key)),
        ]
        for one in experiment.trainings
        for test in experiment.tests
    ]
    return table(head, [*rows, *_baseline_rows(experiment)])


def _baseline_rows(experiment: Experiment) -> Iterator[list[str]]:
    """What the perfect hand and chance reach, the same for every seed, once for each task."""
    seen = set[tuple[str, str]]()
    for one in experiment.trainings:
        for test in experiment.tests:
            task = (one.tokens, test.label)
            if task in seen or not one.scores(test.name, COVERAGE.key):
                continue
            seen.add(task)
            count = len(one.finished[0].result["tokens"])
            for name in ("exact", "random"):
                found: Row = {}
                for seed in reversed(one.finished):
                    found |= seed.tests.get(test.name, {}).get("baselines", {}).get(name, {})
                values = [measure.show(found.get(measure.key)) for measure in GAME_MEASURES]
                yield [name, f"{test.label}, {count} tokens", "", *values, ""]


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


def differences(training: Training, test: Trial, order: str) -> Floats:
    """(E,) coverage with the learned order less that with another, averaged over the seeds."""
    each = []
    for seed in training.finished:
        content = seed.tests.get(test.name, {})
        own, other = content.get(EACH), content.get("baselines", {}).get(order, {}).get(EACH)
        if own is not None and other is not None and len(own) == len(other):
            each.append(np.subtract(own, other))
    return np.mean(each, axis=0) if each else np.zeros(0)


def paired(values: Sequence[float] | Floats) -> str:
    """Mean and 95 % interval of independent differences; `-` of fewer than two."""
    if len(values) < 2:
        return NOTHING
    mean = float(np.mean(values))
    half = NORMAL * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return f"{mean:+.4f} ({mean - half:+.4f} to {mean + half:+.4f})"
