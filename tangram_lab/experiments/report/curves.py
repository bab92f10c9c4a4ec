"""Figures of learning curves: mean and standard deviation over the seeds."""

import itertools
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tangram_lab.experiments.report import paper
from tangram_lab.experiments.report.markdown import REWARD, Measure
from tangram_lab.experiments.report.numbers import Band, band, points
from tangram_lab.experiments.report.references import POSITION, Reference, References
from tangram_lab.experiments.report.study import Experiment, Training, Trial
from tangram_lab.experiments.report.style import (
    DASHES,
    GREY,
    LEVEL,
    PALE,
    Look,
    legend_below,
    new_figure,
    thousands,
)

# Axis of the curves -> its label and what divides it.
AXES = {
    "episodes": ("episodes", 1.0),
    "updates": ("updates (gradient steps)", 1.0),
    "train_s": ("training time (minutes)", 60.0),
}
PER_ROW = 4


def draw_curves(
    experiment: Experiment, looks: Mapping[str, Look], references: References, measure: Measure
) -> Figure | None:
    """Three panels: against episodes, updates and minutes; None if nothing has a curve."""
    known = [one for one in experiment.trainings if _band(one, "updates", measure)]
    if not known:
        return None
    figure, panels = new_figure(3.9, 1, len(AXES), sharey=True)
    for panel, (axis, (label, unit)) in zip(panels, AXES.items(), strict=True):
        for training in known:
            found = _band(training, axis, measure)
            if found is not None:
                _draw_band(panel, found, unit, looks[training.name], training.label)
        if measure is REWARD:
            _draw_papers(panel, experiment, known, looks)
        _draw_levels(panel, references.of(experiment), references.plain, measure)
        panel.set_xlabel(label)
        panel.set_xlim(left=0)
        panel.xaxis.set_major_formatter(thousands())
        panel.locator_params(axis="x", nbins=5)
    panels[0].set_ylabel(measure.axis)
    legend_below(figure, panels[0], 3)
    return figure


def _band(training: Training, axis: str, measure: Measure) -> Band | None:
    return band([seed.curve for seed in training.finished], axis, measure.key)


def _draw_band(panel: Axes, found: Band, unit: float, look: Look, label: str) -> None:
    x = found.x / unit
    seeds = f"{found.seeds} seed{'s' * (found.seeds > 1)}"
    panel.plot(x, found.mean, color=look.colour, linestyle=look.dash, label=f"{label}, {seeds}")
    if found.deviation is not None:
        low, high = found.mean - found.deviation, found.mean + found.deviation
        panel.fill_between(x, low, high, color=look.colour, alpha=0.18, linewidth=0)


def _draw_papers(
    panel: Axes, experiment: Experiment, known: Sequence[Training], looks: Mapping[str, Look]
) -> None:
    """What the paper's agents reach, each in its training's colour."""
    for training in known:
        value = paper.value(experiment, training)
        if value is not None and value.mean_reward is not None:
            label = f"{training.label}, the paper's: {value.mean_reward:.2f}"
            colour = looks[training.name].colour
            panel.axhline(
                value.mean_reward, color=colour, linestyle=":", linewidth=1.4, label=label
            )


def _draw_levels(
    panel: Axes, references: Sequence[Reference], tests: Sequence[Trial], measure: Measure
) -> None:
    """What policies reach that learned nothing, and the most there is."""
    dashes = itertools.cycle(DASHES[1:])
    for reference in references:
        score = reference.score(tests, measure)
        if reference.name == POSITION and score is not None:
            label = f"{reference.label}: {score:.2f}"
            panel.axhline(score, color=GREY, linestyle=next(dashes), linewidth=1.2, label=label)
    panel.axhline(1.0, color=LEVEL, linewidth=1.0, zorder=1, label="perfect: 1")


def draw_single_seeds(experiment: Experiment, looks: Mapping[str, Look]) -> Figure | None:
    """A small panel for each training: every seed's mean reward against updates.

    The first training, which the others are compared with, stands in grey behind each.
    """
    known = [one for one in experiment.trainings if _band(one, "updates", REWARD)]
    if not known:
        return None
    rows, columns = -(-len(known) // PER_ROW), min(PER_ROW, max(len(known), 3))
    figure, panels = new_figure(0.55 + 1.6 * rows, rows, columns, sharex=True, sharey=True)
    for panel, training in zip(panels, known, strict=False):
        if training is not known[0] and known[0] is experiment.trainings[0]:
            _draw_seeds(panel, known[0], PALE, 1.6)
        _draw_seeds(panel, training, looks[training.name].colour, 1.1)
        panel.set_title(training.label, loc="left", fontsize=8.5)
        panel.xaxis.set_major_formatter(thousands())
    for panel in panels[len(known) :]:
        panel.set_visible(False)
    for panel in panels[max(len(known) - columns, 0) : len(known)]:
        panel.tick_params(labelbottom=True)  # the last one of its column
    figure.supxlabel("updates (gradient steps)", fontsize=9.5, color="#374151")
    figure.supylabel(REWARD.axis, fontsize=9.5, color="#374151")
    return figure


def _draw_seeds(panel: Axes, training: Training, colour: str, width: float) -> None:
    for seed in training.finished:
        panel.plot(*points(seed.curve, "updates", REWARD.key), color=colour, linewidth=width)
