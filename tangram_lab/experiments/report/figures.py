"""Figures: learning curves, sweeps over a quantity of the tests, and rankings."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from tangram_lab.experiments.report.numbers import (
    ANGLE,
    REWARD,
    Band,
    Measure,
    Spread,
    band,
    points,
    spread,
)
from tangram_lab.experiments.report.references import (
    PERFECT,
    POSITION,
    References,
    papers,
    papers_score,
)
from tangram_lab.experiments.report.study import Experiment, Study, Training, Trial
from tangram_lab.experiments.report.style import (
    COLOURS,
    DASHES,
    GREY,
    LEVEL,
    MARKERS,
    PALE,
    Look,
    legend_below,
    new_figure,
    thousands,
    widen,
)

# Axis of the curves -> its label and what divides it.
AXES = {
    "episodes": ("episodes", 1.0),
    "updates": ("updates (gradient steps)", 1.0),
    "train_s": ("training time (minutes)", 60.0),
}
PER_ROW = 4
TICKS = 5
NOISE = "noise on the corners, standard deviation (% of the arena)"
ACTIONS = "actions in sequence (count)"

Looks = Mapping[str, Look]


def looks(study: Study) -> dict[str, Look]:
    """Training -> look, the same in every figure.

    Colours repeat when there are more trainings than colours, but not within one figure of curves
    if that can be avoided; then the dashes differ. A ranking names its rows, so it can do with
    colours that are left.
    """
    groups = [
        {training.name for training in experiment.trainings}
        for experiment in sorted(study.experiments, key=lambda one: one.kind == "ranking")
    ]
    chosen: dict[str, int] = {}
    for group in groups:
        for name in (one.name for one in study.trainings if one.name in group):
            if name not in chosen:
                near = {o for other in groups if name in other for o in other} & set(chosen)
                taken = {chosen[other] for other in near}
                chosen[name] = next(i for i in itertools.count() if i not in taken)
    return {name: _look(index) for name, index in chosen.items()}


def _look(index: int) -> Look:
    turn, colour = divmod(index, len(COLOURS))
    return Look(COLOURS[colour], MARKERS[colour], DASHES[turn % len(DASHES)])


# Learning curves: mean and standard deviation over the seeds


def draw_curves(
    experiment: Experiment, looks: Looks, references: References, measure: Measure
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
        _draw_levels(panel, experiment, references, measure)
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
    panel: Axes, experiment: Experiment, known: Sequence[Training], looks: Looks
) -> None:
    """What the paper's agents reach, each in its training's colour."""
    for training in known:
        value = papers(experiment, training)
        if value is not None and value.mean_reward is not None:
            label = f"{training.label}, the paper's: {value.mean_reward:.2f}"
            style: dict[str, Any] = {"color": looks[training.name].colour, "label": label}
            panel.axhline(value.mean_reward, linestyle=":", linewidth=1.4, **style)


def _draw_levels(
    panel: Axes, experiment: Experiment, references: References, measure: Measure
) -> None:
    """What policies reach that learned nothing, and the most there is."""
    dashes = itertools.cycle(DASHES[1:])
    for reference in references.of(experiment):
        score = reference.score(references.plain, measure)
        if reference.name == POSITION and score is not None:
            label = f"{reference.label}: {score:.2f}"
            panel.axhline(score, color=GREY, linestyle=next(dashes), linewidth=1.2, label=label)
    panel.axhline(1.0, color=LEVEL, linewidth=1.0, zorder=1, label="perfect: 1")


def draw_single_seeds(experiment: Experiment, looks: Looks) -> Figure | None:
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


# Tests over a quantity: noise on the corners, or actions in sequence


@dataclass(frozen=True)
class Sweep:
    """Tests that differ in one quantity.

    Attributes:
        name: of the quantity, for the names of files.
        label: of the quantity, with its unit.
        places: the quantity's value and the test, rising.
    """

    name: str
    label: str
    places: tuple[tuple[float, Trial], ...]


def sweeps(experiment: Experiment) -> list[Sweep]:
    """Over noise if tests have it, and over actions if tests without noise differ in them.

    Of several tests at one place the first counts.
    """
    noisy: dict[float, Trial] = {}
    several: dict[float, Trial] = {}
    for test in experiment.tests:
        if test.corner_noise is not None:
            noisy.setdefault(100.0 * test.corner_noise, test)
        if not test.corner_noise and test.actions is not None:
            several.setdefault(float(test.actions or 1), test)
    found = [
        Sweep(name, label, tuple(sorted(places.items(), key=lambda place: place[0])))
        for name, label, places in (("noise", NOISE, noisy), ("actions", ACTIONS, several))
    ]
    return [one for one in found if len(one.places) > 1]


def draw_sweep(
    experiment: Experiment, looks: Looks, references: References, sweep: Sweep
) -> Figure | None:
    """Two panels, mean reward and angle error: the median, and least to most; None without any."""
    known = [t for t in experiment.trainings if _spreads(t, sweep, REWARD)]
    if not known:
        return None
    figure, panels = new_figure(3.8, 1, 2)
    for panel, measure in zip(panels, (REWARD, ANGLE), strict=True):
        for training in known:
            _draw_line(panel, training, sweep, measure, looks[training.name])
        _draw_others(panel, experiment, references, sweep, measure, looks)
        panel.set_xlabel(sweep.label)
        panel.set_ylabel(measure.axis)
        places = [at for at, _ in sweep.places]
        panel.margins(y=0.08)
        if measure is ANGLE:
            widen(panel, "y", [y for line in panel.lines for y in np.ravel(line.get_ydata())])
        panel.set_xticks(places, [f"{at:g}" for at in places])
    legend_below(figure, panels[0])
    return figure


def _spreads(training: Training, sweep: Sweep, measure: Measure) -> dict[float, Spread]:
    pairs = [(x, spread(training.scores(t.name, measure.key).values())) for x, t in sweep.places]
    return {x: known for x, known in pairs if known is not None}


def _draw_line(panel: Axes, training: Training, sweep: Sweep, measure: Measure, look: Look) -> None:
    found = _spreads(training, sweep, measure)
    x, known = list(found), list(found.values())
    style: dict[str, Any] = {"color": look.colour, "linestyle": look.dash, "marker": look.marker}
    panel.plot(x, [one.median for one in known], markersize=5.5, label=training.label, **style)
    lows, highs = [one.least for one in known], [one.most for one in known]
    panel.fill_between(x, lows, highs, color=look.colour, alpha=0.18, linewidth=0)


def _draw_others(
    panel: Axes,
    experiment: Experiment,
    references: References,
    sweep: Sweep,
    measure: Measure,
    looks: Looks,
) -> None:
    """The paper's, position only (dashed), and perfect, which sees the same noise."""
    if measure is REWARD:
        for training in experiment.trainings:
            told = [papers_score(experiment, training, test) for _, test in sweep.places]
            colour, label = looks[training.name].colour, f"{training.label}, the paper's"
            _draw_points(panel, sweep, told, "D", mfc="white", ms=7, color=colour, label=label)
    for reference in references.of(experiment):
        told = [reference.score([test], measure) for _, test in sweep.places]
        if reference.name == POSITION:
            style: dict[str, Any] = {"linewidth": 1.2, "color": GREY, "label": reference.label}
            _draw_points(panel, sweep, told, "--", **style)
        elif reference.name == PERFECT and measure is REWARD:
            style = {"linewidth": 1.0, "color": LEVEL, "label": reference.label}
            _draw_points(panel, sweep, told, "-", **style)


def _draw_points(
    panel: Axes, sweep: Sweep, values: Sequence[float | None], shape: str, **style: Any
) -> None:
    pairs = zip(sweep.places, values, strict=True)
    known = {x: y for (x, _), y in pairs if y is not None}
    if known:
        panel.plot(list(known), list(known.values()), shape, **style)


# Rankings: final scores, training by training


def draw_ranking(experiment: Experiment, looks: Looks, references: References) -> Figure | None:
    """A row for each training, a dot for each seed, a tick at the median; None without scores."""
    known = [one for one in experiment.trainings if one.values(REWARD.key)]
    if not known:
        return None
    figure, panels = new_figure(1.2 + 0.3 * len(known), 1, 2, sharey=True)
    for panel, measure in zip(panels, (REWARD, ANGLE), strict=True):
        shown: list[float] = []
        for row, training in enumerate(known):
            values = training.values(measure.key)
            _draw_row(panel, row, values, looks[training.name].colour)
            shown += values.values()
            position = references.position(training, measure)
            if position is not None:
                style: dict[str, Any] = {"color": GREY, "ms": 4.5, "zorder": 1.5}
                panel.plot(position, row, "D", mfc="white", label=POSITION, **style)
                shown.append(position)
        _mark_first(panel, experiment.trainings[0], measure)
        if measure is ANGLE:
            widen(panel, "x", shown)
        panel.set_xlabel(measure.axis)
        if panel.get_xscale() == "linear":
            panel.xaxis.set_major_locator(MaxNLocator(TICKS))  # more run into each other
        panel.grid(axis="y", visible=False)
    panels[0].set_yticks(range(len(known)), [one.label for one in known])
    panels[0].set_ylim(len(known) - 0.4, -0.6)
    panels[0].plot([], [], "o", color=GREY, ms=5, mew=0, label="one seed")
    panels[0].plot([], [], "|", color=GREY, ms=12, mew=2.2, label="median of the seeds")
    legend_below(figure, panels[0])
    return figure


def _draw_row(panel: Axes, row: int, values: Mapping[int, float], colour: str) -> None:
    known = spread(values.values())
    if known is None:
        return
    dots = list(values.values())
    panel.plot([known.least, known.most], [row, row], color=colour, linewidth=1.2, alpha=0.5)
    panel.plot(dots, [row] * len(dots), "o", color=colour, alpha=0.75, ms=5, mew=0)
    panel.plot(known.median, row, "|", color=colour, ms=14, mew=2.2)


def _mark_first(panel: Axes, first: Training, measure: Measure) -> None:
    """A line at the training that the others are compared with."""
    known = spread(first.values(measure.key).values())
    if known is not None:
        label = f"median of {first.label}"
        panel.axvline(known.median, color=LEVEL, linewidth=1.0, zorder=1, label=label)
