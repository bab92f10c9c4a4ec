"""The section of one experiment: its figures, its tables and what is missing."""

import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from tangram_lab.experiments.report.curves import draw_curves, draw_single_seeds
from tangram_lab.experiments.report.game import assembly_table, order_table
from tangram_lab.experiments.report.markdown import (
    ANGLE,
    DENSE,
    REWARD,
    details,
    picture,
    plain,
    shell,
)
from tangram_lab.experiments.report.ranking import draw_ranking
from tangram_lab.experiments.report.references import References
from tangram_lab.experiments.report.study import Experiment, Study, Training
from tangram_lab.experiments.report.style import Look, save
from tangram_lab.experiments.report.sweeps import draw_sweep, sweeps
from tangram_lab.experiments.report.tables import (
    complexity_table,
    effort_table,
    ranking_table,
    score_table,
    single_tests,
    test_table,
)

BAND = (
    "Mean over the seeds; the band is one standard deviation (n - 1). A curve is drawn over the "
    "range that all seeds of its training cover."
)
DOTS = (
    "Final scores: a dot for each seed, a tick at the median; the diamonds are what the "
    "position-only policy scores at the row's task."
)
SMALL = "Every seed's test scores while it trains; the first training stands in grey behind each."
SWEEP = "Median over the seeds; the band goes from the least to the most."
REACHED = "Episodes are those at the first evaluation in which a seed reached the mean reward."


@dataclass(frozen=True)
class Page:
    """What the sections of a report share.

    Attributes:
        study: that is reported on.
        out: folder of the report.
        figures: folder of the figures in it.
        looks: of every training.
        references: policies to compare with.
    """

    study: Study
    out: Path
    figures: str
    looks: Mapping[str, Look]
    references: References

    def figure(self, name: str, title: str, caption: str, drawn: Figure | None) -> list[str]:
        """Save a figure and embed it; nothing if there was nothing to draw."""
        if drawn is None:
            return []
        save(drawn, self.out / self.figures, name)
        file = f"{self.figures}/{name}"
        return [*picture(title, f"{file}.png"), f"*{caption}* ([SVG]({file}.svg))", ""]


def section(page: Page, experiment: Experiment) -> list[str]:
    """All lines of an experiment; its figures are written on the way."""
    lines = [f'<a id="{experiment.name}"></a>', "", f"## {plain(experiment.title)}", ""]
    if page.study.plan:
        lines += [f"Source: {plain(experiment.source)}. {plain(experiment.note)}", ""]
    if any(one.finished for one in experiment.trainings):
        lines += KINDS[experiment.kind](page, experiment)
        lines += _lacking(page, experiment)
    lines += _gaps(experiment)
    if not page.study.plan:
        return lines
    return [*lines, "Make it again:", "", *shell(command(page.study, experiment))]


def command(study: Study, experiment: Experiment) -> str:
    """What runs this experiment alone, into the same folder, with the study's other settings."""
    try:
        words = shlex.split(study.command)[1:]
    except ValueError:
        words = []
    kept = [word for word in words if _concerns(word, experiment)]
    rest = (shlex.quote(word) for word in kept)
    chosen = f"experiment=[{experiment.name}] budget={study.budget}"
    return " ".join(("tangram-experiment", chosen, *rest))


def _concerns(word: str, experiment: Experiment) -> bool:
    """Whether an argument has a meaning where this experiment is run alone."""
    key = word.partition("=")[0]
    if key.startswith("experiments."):
        return key.startswith(f"experiments.{experiment.name}.")
    return key not in ("experiment", "budget", "dry")


# Kinds


def _curves(page: Page, experiment: Experiment) -> list[str]:
    drawn = draw_curves(experiment, page.looks, page.references, REWARD)
    return [
        *page.figure(experiment.name, experiment.title, BAND, drawn),
        *score_table(page.study, experiment, page.references, REWARD),
        *_effort(experiment),
    ]


def _rewards(page: Page, experiment: Experiment) -> list[str]:
    lines = []
    for measure, name in ((REWARD, experiment.name), (DENSE, f"{experiment.name}_dense")):
        drawn = draw_curves(experiment, page.looks, page.references, measure)
        title = f"{experiment.title}: {measure.label}"
        lines += page.figure(name, title, BAND, drawn)
        lines += score_table(page.study, experiment, page.references, measure)
    return lines + _effort(experiment)


def _effort(experiment: Experiment) -> list[str]:
    return [*effort_table(experiment), REACHED, ""]


def _complexity(_page: Page, experiment: Experiment) -> list[str]:
    return complexity_table(experiment)


def _tests(page: Page, experiment: Experiment) -> list[str]:
    lines = []
    for sweep in sweeps(experiment):
        drawn = draw_sweep(experiment, page.looks, page.references, sweep)
        name, title = f"{experiment.name}_{sweep.name}", f"{experiment.title}: {sweep.name}"
        lines += page.figure(name, title, SWEEP, drawn)
    for measure in (REWARD, ANGLE):
        lines += test_table(experiment, page.references, measure)
    singles = [line for m in (REWARD, ANGLE) for line in single_tests(experiment, m)]
    return lines + details("Every seed", singles)


def _ranking(page: Page, experiment: Experiment) -> list[str]:
    dots = draw_ranking(experiment, page.looks, page.references)
    singles = draw_single_seeds(experiment, page.looks)
    return [
        *page.figure(experiment.name, experiment.title, DOTS, dots),
        *ranking_table(page.study, experiment, page.references),
        *page.figure(f"{experiment.name}_seeds", f"{experiment.title}: curves", SMALL, singles),
    ]


def _game(_page: Page, experiment: Experiment) -> list[str]:
    return [*assembly_table(experiment), *order_table(experiment)]


KINDS: dict[str, Callable[[Page, Experiment], list[str]]] = {
    "curves": _curves,
    "rewards": _rewards,
    "complexity": _complexity,
    "tests": _tests,
    "ranking": _ranking,
    "game": _game,
}

# What is not there


def _lacking(page: Page, experiment: Experiment) -> list[str]:
    lacking = (
        [] if experiment.kind in ("complexity", "game") else page.references.lacking(experiment)
    )
    return [f"Left out, since no test has their scores: {plain('; '.join(lacking))}.", ""] * bool(
        lacking
    )


def _gaps(experiment: Experiment) -> list[str]:
    gaps = [gap for training in experiment.trainings for gap in _gaps_of(experiment, training)]
    return ["Missing:", "", *(f"- {plain(gap)}" for gap in gaps), ""] if gaps else []


def _gaps_of(experiment: Experiment, training: Training) -> Iterator[str]:
    left = [f"seed {seed.number} {seed.state}" for seed in training.seeds if not seed.finished]
    if left:
        count = f"{len(training.finished)} of {len(training.seeds)} seeds"
        yield f"{training.label} ({count}): {', '.join(left)}"
    for seed in training.finished:
        untested = [t.label for t in experiment.tests if t.name not in seed.tests]
        if untested:
            yield f"{training.label}: seed {seed.number} not tested with {', '.join(untested)}"
