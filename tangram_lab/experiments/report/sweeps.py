"""Figures of tests over a quantity: noise on the corners, or actions in sequence."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tangram_lab.experiments.report import paper
from tangram_lab.experiments.report.markdown import ANGLE, REWARD, Measure
from tangram_lab.experiments.report.numbers import Spread, spread
from tangram_lab.experiments.report.references import PERFECT, POSITION, References
from tangram_lab.experiments.report.study import Experiment, Training, Trial
from tangram_lab.experiments.report.style import GREY, LEVEL, Look, legend_below, new_figure, widen

MEASURES = (REWARD, ANGLE)
NOISE = "noise on the corners, standard deviation (% of the arena)"
ACTIONS = "actions in sequence (count)"


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
    """Over noise if tests have it, and over actions if tests without noise differ in them."""
    noisy = [t for t in experiment.tests if t.corner_noise is not None]
    exact = [t for t in experiment.tests if not t.corner_noise and t.actions is not None]
    found = [
        Sweep("noise", NOISE, _rising((100.0 * (t.corner_noise or 0.0), t) for t in noisy)),
        Sweep("actions", ACTIONS, _rising((float(t.actions or 1), t) for t in exact)),
    ]
    return [one for one in found if len(one.places) > 1]


def draw_sweep(
    experiment: Experiment, looks: Mapping[str, Look], references: References, sweep: Sweep
) -> Figure | None:
    """Two panels, mean reward and angle error: the median, and least to most; None without any."""
    known = [t for t in experiment.trainings if _spreads(t, sweep, REWARD)]
    if not known:
        return None
    figure, panels = new_figure(3.8, 1, len(MEASURES))
    for panel, measure in zip(panels, MEASURES, strict=True):
        for training in known:
            _draw_line(panel, training, sweep, measure, looks[training.name])
        if measure is REWARD:
            _draw_papers(panel, experiment, sweep, looks)
        _draw_references(panel, experiment, references, sweep, measure)
        panel.set_xlabel(sweep.label)
        panel.set_ylabel(measure.axis)
        places = [at for at, _ in sweep.places]
        panel.margins(y=0.08)
        if measure is ANGLE:
            widen(panel, "y", [y for line in panel.lines for y in np.ravel(line.get_ydata())])
        panel.set_xticks(places, [f"{at:g}" for at in places])
    legend_below(figure, panels[0])
    return figure


def _rising(places: Iterable[tuple[float, Trial]]) -> tuple[tuple[float, Trial], ...]:
    """In order; of several tests at one place the first."""
    firsts: dict[float, Trial] = {}
    for x, trial in places:
        firsts.setdefault(x, trial)
    return tuple(sorted(firsts.items(), key=lambda place: place[0]))


def _spreads(training: Training, sweep: Sweep, measure: Measure) -> list[tuple[float, Spread]]:
    pairs = [(x, spread(training.scores(t.name, measure.key).values())) for x, t in sweep.places]
    return [(x, known) for x, known in pairs if known is not None]


def _draw_line(panel: Axes, training: Training, sweep: Sweep, measure: Measure, look: Look) -> None:
    found = _spreads(training, sweep, measure)
    x = [at for at, _ in found]
    medians = [known.median for _, known in found]
    style: dict[str, Any] = {"color": look.colour, "linestyle": look.dash, "marker": look.marker}
    panel.plot(x, medians, markersize=5.5, label=training.label, **style)
    lows, highs = [known.least for _, known in found], [known.most for _, known in found]
    panel.fill_between(x, lows, highs, color=look.colour, alpha=0.18, linewidth=0)


def _draw_papers(
    panel: Axes, experiment: Experiment, sweep: Sweep, looks: Mapping[str, Look]
) -> None:
    for training in experiment.trainings:
        values = [(x, paper.trial_value(experiment, training, t)) for x, t in sweep.places]
        label = f"{training.label}, the paper's"
        _draw_points(
            panel, values, "D", mfc="white", ms=7, color=looks[training.name].colour, label=label
        )


def _draw_references(
    panel: Axes, experiment: Experiment, references: References, sweep: Sweep, measure: Measure
) -> None:
    """Position only, dashed; perfect, which sees the same noise, in the reward's panel."""
    for reference in references.of(experiment):
        values = [(x, reference.score([t], measure)) for x, t in sweep.places]
        if reference.name == POSITION:
            _draw_points(panel, values, "--", linewidth=1.2, color=GREY, label=reference.label)
        elif reference.name == PERFECT and measure is REWARD:
            _draw_points(panel, values, "-", linewidth=1.0, color=LEVEL, label=reference.label)


def _draw_points(
    panel: Axes, values: Sequence[tuple[float, float | None]], shape: str, **style: Any
) -> None:
    known = [(x, y) for x, y in values if y is not None]
    if known:
        panel.plot([x for x, _ in known], [y for _, y in known], shape, **style)
