"""Figures: learning curves, sweeps over a quantity of the tests, and rankings.

Each is None where there is nothing to draw.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from tangram_lab.experiments.report.numbers import (
    ANGLE,
    EPISODES,
    MINUTES,
    REWARD,
    UPDATES,
    Band,
    Measure,
    band,
    points,
    spread,
)
from tangram_lab.experiments.report.references import (
    PERFECT,
    POSITION,
    papers,
    papers_score,
    position,
    references,
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

PER_ROW = 4
TICKS = 5
NOISE = "noise on the corners, standard deviation (% of the arena)"
ACTIONS = "actions in sequence (count)"


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


def draw_curves(study: Study, experiment: Experiment, measure: Measure) -> Figure | None:
    """Three panels: against episodes, updates and minutes."""
    known = _with_curves(experiment, measure)
    if not known:
        return None
    look, axes = looks(study), (EPISODES, UPDATES, MINUTES)
    figure, panels = new_figure(3.9, 1, len(axes), sharey=True)
    for panel, axis in zip(panels, axes, strict=True):
        for training in known:
            if found := _band(training, axis, measure):
                count = f"{found.seeds} seed{'s' * (found.seeds > 1)}"
                low_high = None
                if found.deviation is not None:
                    low_high = (found.mean - found.deviation, found.mean + found.deviation)
                x, label = found.x * axis.factor, f"{training.label}, {count}"
                _draw_line(panel, x, found.mean, low_high, look[training.name], label=label)
        for training in known if measure is REWARD else ():
            told = papers(experiment, training).get("mean_reward")
            if told is not None:
                label = f"{training.label}, the paper's: {told:.2f}"
                _draw_level(panel, told, look[training.name].colour, ":", 1.4, label)
        dashes = itertools.cycle(DASHES[1:])
        for policy in references(study, experiment):
            score = policy.score(measure)
            if policy.name == POSITION and score is not None:
                _draw_level(panel, score, GREY, next(dashes), 1.2, f"{policy.label}: {score:.2f}")
        panel.axhline(1.0, color=LEVEL, linewidth=1.0, zorder=1, label="perfect: 1")
        panel.set_xlabel(axis.axis)
        panel.set_xlim(left=0)
        panel.xaxis.set_major_formatter(thousands())
        panel.locator_params(axis="x", nbins=5)
    panels[0].set_ylabel(measure.axis)
    legend_below(figure, panels[0], 3)
    return figure


def _with_curves(experiment: Experiment, measure: Measure) -> list[Training]:
    return [one for one in experiment.trainings if _band(one, UPDATES, measure)]


def _band(training: Training, axis: Measure, measure: Measure) -> Band | None:
    return band([seed.curve for seed in training.finished], axis.key, measure.key)


def _draw_line(panel: Axes, x: Any, y: Any, low_high: Any, look: Look, **style: Any) -> None:
    panel.plot(x, y, color=look.colour, linestyle=look.dash, **style)
    if low_high is not None:
        panel.fill_between(x, *low_high, color=look.colour, alpha=0.18, linewidth=0)


def _draw_level(panel: Axes, y: float, colour: str, dash: Any, width: float, label: str) -> None:
    panel.axhline(y, color=colour, linestyle=dash, linewidth=width, label=label)


def draw_single_seeds(study: Study, experiment: Experiment) -> Figure | None:
    """A small panel for each training: every seed's mean reward against updates.

    The first training, which the others are compared with, stands in grey behind each.
    """
    known = _with_curves(experiment, REWARD)
    if not known:
        return None
    rows, columns = -(-len(known) // PER_ROW), min(PER_ROW, max(len(known), 3))
    figure, panels = new_figure(0.55 + 1.6 * rows, rows, columns, sharex=True, sharey=True)
    for panel, training in zip(panels, known, strict=False):
        if training is not known[0] and known[0] is experiment.trainings[0]:
            _draw_seeds(panel, known[0], PALE, 1.6)
        _draw_seeds(panel, training, looks(study)[training.name].colour, 1.1)
        panel.set_title(training.label, loc="left", fontsize=8.5)
        panel.xaxis.set_major_formatter(thousands())
    for panel in panels[len(known) :]:
        panel.set_visible(False)
    for panel in panels[max(len(known) - columns, 0) : len(known)]:
        panel.tick_params(labelbottom=True)  # the last one of its column
    figure.supxlabel(UPDATES.axis, fontsize=9.5, color="#374151")
    figure.supylabel(REWARD.axis, fontsize=9.5, color="#374151")
    return figure


def _draw_seeds(panel: Axes, training: Training, colour: str, width: float) -> None:
    for seed in training.finished:
        panel.plot(*points(seed.curve, UPDATES.key, REWARD.key), color=colour, linewidth=width)


# Tests over a quantity: noise on the corners, or actions in sequence


class Sweep(NamedTuple):
    """Tests that differ in one quantity: its name for files, its label, its values -> tests."""

    name: str
    label: str
    places: dict[float, Trial]


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
            several.setdefault(test.actions or 1.0, test)
    found = (("noise", NOISE, noisy), ("actions", ACTIONS, several))
    return [Sweep(n, label, dict(sorted(o.items()))) for n, label, o in found if len(o) > 1]


def draw_sweep(study: Study, experiment: Experiment, sweep: Sweep) -> Figure | None:
    """Two panels, mean reward and angle error: the median, and least to most."""
    places = list(sweep.places)
    known = [
        one
        for one in experiment.trainings
        if any(one.values(REWARD.key, test.name) for test in sweep.places.values())
    ]
    if not known:
        return None
    look = looks(study)
    figure, panels = new_figure(3.8, 1, 2)
    for panel, measure in zip(panels, (REWARD, ANGLE), strict=True):
        for training in known:
            tests = sweep.places.items()
            pairs = [(x, spread(training.values(measure.key, t.name).values())) for x, t in tests]
            found = {x: one for x, one in pairs if one is not None}
            least, median, most = zip(*found.values(), strict=True) if found else ((), (), ())
            style: dict[str, Any] = {"marker": look[training.name].marker, "markersize": 5.5}
            style["label"] = training.label
            x = list(found)
            _draw_line(panel, x, median, (least, most), look[training.name], **style)
        _draw_others(panel, study, experiment, sweep, measure)
        panel.set_xlabel(sweep.label)
        panel.set_ylabel(measure.axis)
        panel.margins(y=0.08)
        if measure is ANGLE:
            widen(panel, "y", [y for line in panel.lines for y in np.ravel(line.get_ydata())])
        panel.set_xticks(places, [f"{at:g}" for at in places])
    legend_below(figure, panels[0])
    return figure


def _draw_others(
    panel: Axes, study: Study, experiment: Experiment, sweep: Sweep, measure: Measure
) -> None:
    """The paper's, position only (dashed), and perfect, which sees the same noise."""

    def draw(values: Iterable[float | None], shape: str, **style: Any) -> None:
        known = {x: y for x, y in zip(sweep.places, values, strict=True) if y is not None}
        if known:
            panel.plot(list(known), list(known.values()), shape, **style)

    tests = sweep.places.values()
    for training in experiment.trainings if measure is REWARD else ():
        told = [papers_score(experiment, training, test) for test in tests]
        colour, label = looks(study)[training.name].colour, f"{training.label}, the paper's"
        draw(told, "D", mfc="white", ms=7, color=colour, label=label)
    for policy in references(study, experiment):
        told = [policy.score(measure, test) for test in tests]
        if policy.name == POSITION:
            draw(told, "--", linewidth=1.2, color=GREY, label=policy.label)
        elif policy.name == PERFECT and measure is REWARD:
            draw(told, "-", linewidth=1.0, color=LEVEL, label=policy.label)


# Rankings: final scores, training by training


def draw_ranking(study: Study, experiment: Experiment) -> Figure | None:
    """A row for each training, a dot for each seed, a tick at the median."""
    known = [one for one in experiment.trainings if one.values(REWARD.key)]
    if not known:
        return None
    figure, panels = new_figure(1.2 + 0.3 * len(known), 1, 2, sharey=True)
    for panel, measure in zip(panels, (REWARD, ANGLE), strict=True):
        shown: list[float] = []
        for row, training in enumerate(known):
            values = list(training.values(measure.key).values())
            _draw_row(panel, row, values, looks(study)[training.name].colour)
            shown += values
            level = position(study, training).score(measure)
            if level is not None:
                style: dict[str, Any] = {"color": GREY, "ms": 4.5, "zorder": 1.5}
                panel.plot(level, row, "D", mfc="white", label=POSITION, **style)
                shown.append(level)
        first = experiment.trainings[0]
        if middle := spread(first.values(measure.key).values()):
            label = f"median of {first.label}"
            panel.axvline(middle.median, color=LEVEL, linewidth=1.0, zorder=1, label=label)
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


def _draw_row(panel: Axes, row: int, values: Sequence[float], colour: str) -> None:
    if known := spread(values):
        panel.plot([known.least, known.most], [row, row], color=colour, linewidth=1.2, alpha=0.5)
        panel.plot(values, [row] * len(values), "o", color=colour, alpha=0.75, ms=5, mew=0)
        panel.plot(known.median, row, "|", color=colour, ms=14, mew=2.2)
