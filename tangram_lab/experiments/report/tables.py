"""The tables of each kind of experiment, and the pieces of Markdown that pages are made of."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import compress, product

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
    reached,
)
from tangram_lab.experiments.report.reading import EACH
from tangram_lab.experiments.report.references import (
    papers,
    papers_score,
    references,
    references_in_changed_worlds,
)
from tangram_lab.experiments.report.statistics import ENOUGH, difference, interquartile_mean
from tangram_lab.experiments.report.study import Experiment, Row, Study, Training, Trial
from tangram_sim.arrays import Floats

SPREAD = "median (least to most)"
LEVELS = (0.70, 0.75)  # that the paper tells of in Fig. 4
# With several tokens.
COVERAGE = Measure("coverage", "coverage", "{:.4f}")
SOLVED_IOU = Measure("share_solved_iou", "solved, IoU 0.95", "{:.1f} %", 100)
GAME_MEASURES = (
    COVERAGE,
    Measure("share_solved", "solved", "{:.1f} %", 100),
    SOLVED_IOU,
    Measure("iou", "IoU", "{:.3f}"),
    *(POSITION, ANGLE),
    Measure("wrong", "wrong pieces", "{:.2f}"),
    Measure("doubly_used", "doubly used", "{:.2f}"),
    Measure("blocked", "refused placements", "{:.2f}"),
    Measure("seconds_per_puzzle", "ms per target", "{:,.0f}", 1000),
)
ORDERS = ("order=listed", "order=size", "order=random")
OF_AGENTS = (*ORDERS, "lookahead=none")  # what its weights do otherwise
ORDER_NOTE = (
    "The learned order less a fixed one, on the same starts and targets with the same weights: "
    "mean difference of the coverage and its 95 % interval over the episodes, each averaged over "
    "the seeds; then the means of the seeds, from least to most. Of puzzles the interval is too "
    "narrow, for each of their angles counts as an episode."
)
PUZZLE_NOTE = "The same weights in the order that they learned and in fixed ones:"
# Two-sided 95 % of a normal distribution: there are a hundred pairs and more.
NORMAL = 1.96


# In worlds whose motion is not known: name of a policy in the files of tests -> in tables.
FORMULA, ORACLE = "exact", "oracle"
COMPARED = {
    FORMULA: "formula",
    "fitted": "fitted",
    ORACLE: ORACLE,
    "position only": "position only",
}
PRECISE = REWARD._replace(pattern="{:.4f}")


# Markdown


def table(head: Sequence[str], rows: Iterable[Sequence[str]], rest: str = "---:") -> list[str]:
    """A table; the columns after the first are numbers, unless `rest` is `---`.

    A row that is too short ends with empty cells.
    """
    full = [[*row, *[""] * (len(head) - len(row))] for row in (head, *rows)]
    escaped = [[plain(cell).replace("|", "\\|") for cell in row] for row in full]
    escaped.insert(1, ["---", *[rest] * (len(head) - 1)])
    return [*(f"| {' | '.join(cells)} |" for cells in escaped), ""]


def details(summary: str, lines: Sequence[str]) -> list[str]:
    """Lines that unfold with a click."""
    return ["<details>", f"<summary>{plain(summary)}</summary>", "", *lines, "</details>", ""]


def shell(command: str) -> list[str]:
    """A command to copy; tests/blocks.py runs it on request."""
    return ["<!-- run: on request -->", "```bash", command, "```", ""]


def plain(text: str) -> str:
    """A text that shows as it stands, in a line of Markdown."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace("\n", " ")


def picture(title: str, file: str) -> list[str]:
    """A figure by its relative path."""
    alternative = plain(title).replace("[", "(").replace("]", ")")
    return [f"![{alternative}]({file})", ""]


# One token: columns, each a head and the cell of a training


Cell = Callable[[Training], str]
Column = tuple[str, Cell]

LABEL: Column = ("training", lambda one: one.label)
SEEDS: Column = ("seeds", lambda one: f"{len(one.finished)} of {len(one.seeds)}")


def _table(
    columns: Sequence[Column], trainings: Iterable[Training], others: Iterable[Sequence[str]] = ()
) -> list[str]:
    rows = [[cell(one) for _, cell in columns] for one in trainings]
    return table([head for head, _ in columns], [*rows, *others])


def _measured_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], others: Iterable[Sequence[str]] = ()
) -> list[str]:
    """A table without the columns that no row has a score in, but for the coverage."""
    columns = zip(head, *rows, strict=True)
    told = [name == COVERAGE.label or {*cells} != {NOTHING} for name, *cells in columns]
    every = (list(compress(row, told)) for row in [*rows, *others])
    return table(list(compress(head, told)), every)


def _over_seeds(measure: Measure, test: str | None = None) -> Cell:
    return lambda one: measure.show_spread(one.values(measure.key, test))


def _measured(*measures: Measure, test: str | None = None) -> list[Column]:
    return [(measure.label, _over_seeds(measure, test)) for measure in measures]


def _tested(measure: Measure, tests: Iterable[Trial]) -> list[Column]:
    return [(test.label, _over_seeds(measure, test.name)) for test in tests]


def _iqm(experiment: Experiment) -> list[Column]:
    """The interquartile mean of the mean reward, where there are seeds enough for one."""
    if all(len(one.finished) < ENOUGH for one in experiment.trainings):
        return []
    test = experiment.main_test

    def cell(one: Training) -> str:
        values = list(one.values(REWARD.key, test).values())
        if len(values) < ENOUGH:
            return NOTHING
        middle, low, high = map(PRECISE.show, interquartile_mean(np.array(values)[:, None]))
        return f"{middle} ({low} to {high})"

    return [("interquartile mean, 95 % interval", cell)]


def _papers(experiment: Experiment, head: str, pattern: str) -> Column:
    def cell(one: Training) -> str:
        try:
            return pattern.format_map(papers(experiment, one))
        except KeyError:
            return NOTHING

    return head, cell


def _if_any(column: Column, experiment: Experiment) -> list[Column]:
    return [column] if any(column[1](one) != NOTHING for one in experiment.trainings) else []


def score_table(study: Study, experiment: Experiment, measure: Measure) -> list[str]:
    """Scores: the paper's, ours over the seeds, and policies without learning."""
    told = _papers(experiment, "paper", "{mean_reward:.2f}")
    paper = _if_any(told, experiment) if measure is REWARD else []
    ours = (f"{measure.label}, {SPREAD}", _over_seeds(measure, experiment.main_test))
    columns = [LABEL, SEEDS, *paper, ours, *(_iqm(experiment) if measure is REWARD else [])]
    others = [
        [policy.label, *[""] * (1 + len(paper)), measure.show(policy.score(measure))]
        for policy in references(study, experiment)
    ]
    return _table(columns, experiment.trainings, others)


def effort_table(experiment: Experiment) -> list[str]:
    """How soon the paper's two rewards were reached, the errors at the end, and what it took."""
    paper = _papers(experiment, "paper, episodes", "{mean_reward:.2f} after {after:,}")
    soon = [_soon(level) for level in LEVELS]
    test = experiment.main_test
    took = [*_measured(ANGLE, POSITION, test=test), *_measured(EPISODES, UPDATES, MINUTES)]
    return _table([LABEL, *_if_any(paper, experiment), *soon, *took], experiment.trainings)


def _soon(level: float) -> Column:
    """Between which episodes a mean reward was first reached, and by how many seeds if not by all.

    Medians of the evaluation before and of the one that had it.
    """

    def cell(one: Training) -> str:
        found = [pair for seed in one.finished if (pair := reached(seed, level)) is not None]
        if not found:
            return NOTHING
        few = f", {len(found)} of {len(one.finished)} seeds" * (len(found) < len(one.finished))
        return " to ".join(map(EPISODES.show, np.median(found, axis=0).tolist())) + few

    return f"{level:.2f} reached between episodes", cell


def complexity_table(experiment: Experiment) -> list[str]:
    """Table I: parameters, time and episodes, the paper's beside ours."""
    columns = [
        *(LABEL, SEEDS, _papers(experiment, "paper: parameters", "{parameters:,}")),
        *(*_measured(PARAMETERS), _papers(experiment, "paper: time, h", "{hours:g}")),
        *(*_measured(HOURS), _papers(experiment, "paper: episodes", "{episodes:,}")),
        *_measured(EPISODES, UPDATES),
        *_measured(REWARD, test=experiment.main_test),
    ]
    return _table(columns, experiment.trainings)


def test_table(study: Study, experiment: Experiment, measure: Measure) -> list[str]:
    """Rows are trainings, columns are tests; the paper's values and other policies below."""
    tests, rows = experiment.tests, []
    columns = [LABEL, SEEDS, *_tested(measure, tests)]
    for one in experiment.trainings:
        rows.append([cell(one) for _, cell in columns])
        paper = [papers_score(experiment, one, test) for test in tests]
        if measure is REWARD and any(paper):
            rows.append([f"{one.label}, the paper's", "", *map(measure.show, paper)])
    for policy in references(study, experiment):
        scores = [policy.score(measure, test) for test in tests]
        if any(score is not None for score in scores):
            rows.append([policy.label, "", *map(measure.show, scores)])
    return table([f"{measure.label}, {SPREAD}", "seeds", *(test.label for test in tests)], rows)


def ranking_table(study: Study, experiment: Experiment) -> list[str]:
    """Every training beside the first: medians, and the difference of their tests in pairs."""
    first, test, means = experiment.trainings[0], experiment.main_test, _iqm(experiment)
    columns = [
        LABEL,
        SEEDS,
        (f"{REWARD.label}, {SPREAD}", _over_seeds(REWARD, test)),
        *means,
        (_difference_head(experiment), _difference(first, test)),
        (f"{ANGLE.label}, {SPREAD}", _over_seeds(ANGLE, test)),
        _soon(LEVELS[0]),
        *_measured(MINUTES),
    ]
    space = [""] * len(means)
    others = [
        [one.label, "", REWARD.show(one.score(REWARD)), *space, "", ANGLE.show(one.score(ANGLE))]
        for policies in (references, references_in_changed_worlds)
        for one in policies(study, experiment)
    ]
    return _table(columns, experiment.trainings, others)


def _difference_head(experiment: Experiment) -> str:
    few = all(len(one.finished) < ENOUGH for one in experiment.trainings)
    return "difference" if few else "difference, 95 % interval over seeds and tests"


def _difference(first: Training, test: str | None) -> Cell:
    """Of the mean rewards, on the same test episodes; an interval where both have enough seeds."""

    def cell(one: Training) -> str:
        if one is first:
            return "reference"
        ours, theirs = _each(one, test), _each(first, test)
        if not (ours and theirs and len({len(row) for row in ours + theirs}) == 1):
            return NOTHING
        found = difference(2.0 * np.array(ours), 2.0 * np.array(theirs))
        if min(len(ours), len(theirs)) < ENOUGH:
            return f"{found.estimate:+.4f}"
        return "{:+.4f} ({:+.4f} to {:+.4f})".format(*found)

    return cell


def _each(training: Training, test: str | None) -> list[Floats]:
    """Of every seed that has a test (E,) the coverage of its episodes."""
    each = (seed.tests.get(test or "", {}).get(EACH) for seed in training.finished)
    return [np.array(one) for one in each if one is not None]


def _over_all(each: Sequence[Floats]) -> Floats:
    """(E,) means over the seeds; nothing where they were tested on different episodes."""
    one_set = len({len(one) for one in each}) == 1
    return np.mean(each, axis=0) if one_set else np.zeros(0)


# Several tokens


def assembly_table(experiment: Experiment) -> list[str]:
    """Scores of every training in every test, and of policies that learned nothing.

    But for the coverage, what nobody measured has no column.
    """
    head = ["training", "test", "seeds", *(one.label for one in GAME_MEASURES), MINUTES.label]
    rows = [
        [
            one.label,
            test.label,
            str(len(one.values(COVERAGE.key, test.name))),
            *(m.show_spread(one.values(m.key, test.name)) for m in GAME_MEASURES),
            MINUTES.show_spread(one.values(MINUTES.key)),
        ]
        for one in experiment.trainings
        for test in experiment.tests
    ]
    return _measured_table(head, rows, _baseline_rows(experiment))


def _baseline_rows(experiment: Experiment) -> Iterator[list[str]]:
    """What others reach that learned nothing, the same for every seed, once for each task."""
    seen = list[tuple[str, str, object]]()
    for one in experiment.trainings:
        for test in experiment.tests:
            task = (one.tokens, test.label, one.settings.get("sim"))
            if task in seen or not one.values(COVERAGE.key, test.name):
                continue
            count = f"{len(one.finished[0].result['tokens'])} tokens"
            again = task[:2] in (before[:2] for before in seen)
            seen.append(task)
            others: Row = {}
            for seed in one.finished:
                others = seed.tests.get(test.name, {}).get("baselines", {}) | others
            for name in (name for name in others if name not in OF_AGENTS):
                values = [measure.show(others[name].get(measure.key)) for measure in GAME_MEASURES]
                yield [name, f"{test.label}, {one.label if again else count}", "", *values, ""]


def order_table(experiment: Experiment) -> list[str]:
    """Learned order less each fixed one: mean of the paired differences, 95 % interval, seeds.

    Pairs are the same episode played by the same weights. The interval is over the episodes, of
    which each was averaged over the seeds; how the seeds differ stands beside it.
    """
    head = ["training", "test", "learned", *(f"less {name}" for name in ORDERS)]
    rows = []
    for one in experiment.trainings:
        for test in experiment.tests:
            learned = one.values(COVERAGE.key, test.name)
            shown = [with_seeds(differences(one, test, name)) for name in ORDERS]
            if {*shown} - {NOTHING}:
                rows.append([one.label, test.label, COVERAGE.show_spread(learned), *shown])
    return [plain(ORDER_NOTE), "", *table(head, rows)] if rows else []


def puzzle_order_table(experiment: Experiment) -> list[str]:
    """Coverage and solved of the same weights in each order, in tests that tell no episodes."""
    measures, rows = (COVERAGE, SOLVED_IOU), []
    for one, test in product(experiment.trainings, experiment.tests):
        if any(seed.tests.get(test.name, {}).get(EACH) for seed in one.finished):
            continue
        fixed = {
            order: [one.compared(order, m.key, test.name) for m in measures] for order in ORDERS
        }
        fixed = {order: values for order, values in fixed.items() if all(values)}
        learned = {"learned": [one.values(m.key, test.name) for m in measures]} if fixed else {}
        for order, values in (learned | fixed).items():
            shown = (m.show_spread(v) for m, v in zip(measures, values, strict=True))
            rows.append([one.label, test.label, order, *shown])
    head = ["training", "test", "order", *(m.label for m in measures)]
    return [plain(PUZZLE_NOTE), "", *table(head, rows)] if rows else []


def differences(training: Training, test: Trial, order: str) -> list[Floats]:
    """Of each seed (E,) coverage with the learned order less that with another."""
    each = []
    for seed in training.finished:
        content = seed.tests.get(test.name, {})
        own, other = content.get(EACH), content.get("baselines", {}).get(order, {}).get(EACH)
        if own is not None and other is not None and len(own) == len(other):
            each.append(np.subtract(own, other))
    return each


def with_seeds(each: Sequence[Floats]) -> str:
    """`paired` over the seeds' mean, and where there are several seeds, their least and most."""
    text = paired(_over_all(each))
    if len(each) < 2 or text == NOTHING:
        return text
    means = [float(np.mean(one)) for one in each]
    return f"{text}, seeds {min(means):+.4f} to {max(means):+.4f}"


def paired(values: Sequence[float] | Floats) -> str:
    """Mean and 95 % interval of independent differences; `-` of fewer than two."""
    if len(values) < 2:
        return NOTHING
    mean = float(np.mean(values))
    half = NORMAL * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return f"{mean:+.4f} ({mean - half:+.4f} to {mean + half:+.4f})"


# Worlds whose motion is not known


def worlds_table(experiment: Experiment) -> list[str]:
    """Every training in every test, beside the policies that tangram-eval compares it with."""
    one_test = len(experiment.tests) == 1
    head = ["training", *([] if one_test else ["test"]), "seeds", f"agent, {SPREAD}"]
    rows = []
    for one in experiment.trainings:
        for test in experiment.tests:
            several = one.values(COVERAGE.key, test.name)
            measure = COVERAGE if several else PRECISE
            own = several or one.values(measure.key, test.name)
            policies = (one.compared(name, measure.key, test.name) for name in COMPARED)
            rows.append(
                [
                    f"{one.label}{', coverage' * bool(several)}",
                    *([] if one_test else [test.label]),
                    str(len(own)),
                    *map(measure.show_spread, (own, *policies)),
                ]
            )
    return _measured_table([*head, *COMPARED.values()], rows)
