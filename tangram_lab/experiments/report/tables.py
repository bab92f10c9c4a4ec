"""The tables of each kind of experiment."""

from collections.abc import Iterator

from tangram_lab.experiments.report import paper
from tangram_lab.experiments.report.markdown import (
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
    table,
)
from tangram_lab.experiments.report.numbers import first_at_least
from tangram_lab.experiments.report.references import References
from tangram_lab.experiments.report.study import Experiment, Study, Training, Trial

SPREAD = "median (least to most)"
LEVELS = (0.70, 0.75)  # that the paper tells of in Fig. 4


def score_table(
    study: Study, experiment: Experiment, references: References, measure: Measure
) -> list[str]:
    """Final scores: the paper's, ours over the seeds, every seed, and policies without learning."""
    values = {one.name: paper.value(experiment, one) for one in experiment.trainings}
    papers = {name: value.mean_reward for name, value in values.items() if value is not None}
    with_paper = measure is REWARD and any(value is not None for value in papers.values())
    seeds = study.planned_seeds
    head = ["training", "seeds", *["paper"] * with_paper, f"{measure.label}, {SPREAD}"]
    rows = [
        [
            one.label,
            seed_count(one),
            *[_show(papers.get(one.name), "{:.2f}")] * with_paper,
            measure.show_spread(one.values(measure.key)),
            *(measure.show(one.values(measure.key).get(seed)) for seed in seeds),
        ]
        for one in experiment.trainings
    ]
    for one in references.of(experiment):
        score = measure.show(one.score(references.plain, measure))
        rows.append([one.label, "", *[""] * with_paper, score, *[""] * len(seeds)])
    return table([*head, *(f"seed {seed}" for seed in seeds)], rows)


def effort_table(experiment: Experiment) -> list[str]:
    """How soon the paper's two rewards were reached, the errors at the end, and what it took."""
    values = {one.name: paper.value(experiment, one) for one in experiment.trainings}
    papers = {
        name: f"{value.mean_reward:.2f} after {value.after:,}"
        for name, value in values.items()
        if value is not None and value.mean_reward is not None and value.after is not None
    }
    shown = (ANGLE, POSITION, EPISODES, UPDATES, MINUTES)
    head = ["training", *["paper, episodes"] * bool(papers)]
    head += [f"{level:.2f} after, episodes" for level in LEVELS]
    return table(
        [*head, *(measure.label for measure in shown)],
        (
            [
                one.label,
                *[papers.get(one.name, NOTHING)] * bool(papers),
                *(_soon(one, level) for level in LEVELS),
                *(measure.show_spread(one.values(measure.key)) for measure in shown),
            ]
            for one in experiment.trainings
        ),
    )


def _soon(training: Training, level: float) -> str:
    """Episodes until a mean reward was first reached, and by how many seeds if not by all."""
    reached = training.each(lambda seed: first_at_least(seed, level))
    text = EPISODES.show_spread(reached)
    few = 0 < len(reached) < len(training.finished)
    return f"{text}, {len(reached)} of {len(training.finished)} seeds" if few else text


def complexity_table(experiment: Experiment) -> list[str]:
    """Table I: parameters, time and episodes, the paper's beside ours."""
    head = ["training", "seeds", "paper: parameters", "parameters", "paper: time, h"]
    head += [HOURS.label, "paper: episodes", "episodes", UPDATES.label, REWARD.label]
    rows = []
    for one in experiment.trainings:
        value = paper.value(experiment, one) or paper.Value()
        rows.append(
            [
                one.label,
                seed_count(one),
                _show(value.parameters, "{:,}"),
                PARAMETERS.show_spread(one.values("parameters")),
                _show(value.hours, "{:g}"),
                HOURS.show_spread(one.values("train_s")),
                _show(value.episodes, "{:,}"),
                EPISODES.show_spread(one.values("episodes")),
                UPDATES.show_spread(one.values("updates")),
                REWARD.show_spread(one.values(REWARD.key)),
            ]
        )
    return table(head, rows)


def test_table(experiment: Experiment, references: References, measure: Measure) -> list[str]:
    """Rows are trainings, columns are tests; the paper's values and other policies below."""
    rows = []
    for one in experiment.trainings:
        cells = [measure.show_spread(one.scores(t.name, measure.key)) for t in experiment.tests]
        rows.append([one.label, seed_count(one), *cells])
        papers = [paper.trial_value(experiment, one, t) for t in experiment.tests]
        if measure is REWARD and any(value is not None for value in papers):
            rows.append(
                [f"{one.label}, the paper's", "", *(measure.show(value) for value in papers)]
            )
    for reference in references.of(experiment):
        scores = [reference.score([t], measure) for t in experiment.tests]
        if any(score is not None for score in scores):
            rows.append([reference.label, "", *(measure.show(score) for score in scores)])
    head = [f"{measure.label}, {SPREAD}", "seeds", *(t.label for t in experiment.tests)]
    return table(head, rows)


def single_tests(experiment: Experiment, measure: Measure) -> list[str]:
    """Every seed of every training in every test."""

    def cells(training: Training, seed: int) -> Iterator[str]:
        return (measure.show(training.scores(t.name, measure.key).get(seed)) for t in tests)

    tests: tuple[Trial, ...] = experiment.tests
    rows = (
        [one.label, str(seed.number), *cells(one, seed.number)]
        for one in experiment.trainings
        for seed in one.finished
    )
    return table([measure.label, "seed", *(t.label for t in tests)], rows)


def ranking_table(study: Study, experiment: Experiment, references: References) -> list[str]:
    """Every training beside the first: medians and their differences, and every seed."""
    seeds, first = study.planned_seeds, experiment.trainings[0]
    head = ["training", "seeds", f"{REWARD.label}, {SPREAD}", "difference"]
    head += [f"{ANGLE.label}, {SPREAD}", "difference", MINUTES.label]
    rows = []
    for one in experiment.trainings:
        rewards = one.values(REWARD.key)
        cells = [one.label, seed_count(one)]
        for measure in (REWARD, ANGLE):
            values = one.values(measure.key)
            cells += [measure.show_spread(values), _difference(measure, one, first)]
        cells.append(MINUTES.show_spread(one.values(MINUTES.key)))
        rows.append(cells + [REWARD.show(rewards.get(seed)) for seed in seeds])
    for reference in references.of(experiment):
        reward, angle = (m.show(reference.score(references.plain, m)) for m in (REWARD, ANGLE))
        rows.append([reference.label, "", reward, "", angle, "", "", *[""] * len(seeds)])
    return table([*head, *(f"seed {seed}" for seed in seeds)], rows)


def seed_count(training: Training) -> str:
    """How many seeds are finished, of how many."""
    return f"{len(training.finished)} of {len(training.seeds)}"


def _difference(measure: Measure, training: Training, first: Training) -> str:
    if training is first:
        return "reference"
    return measure.show_difference(training.values(measure.key), first.values(measure.key))


def _show(value: float | None, pattern: str) -> str:
    return NOTHING if value is None else pattern.format(value)
