"""Figures of rankings: final scores, training by training, a dot for every seed."""

from collections.abc import Mapping

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from tangram_lab.experiments.report.markdown import ANGLE, REWARD, Measure
from tangram_lab.experiments.report.numbers import spread
from tangram_lab.experiments.report.references import POSITION, References
from tangram_lab.experiments.report.study import Experiment, Training
from tangram_lab.experiments.report.style import GREY, LEVEL, Look, legend_below, new_figure, widen

TICKS = 5
MEASURES = (REWARD, ANGLE)


def draw_ranking(
    experiment: Experiment, looks: Mapping[str, Look], references: References
) -> Figure | None:
    """A row for each training, a dot for each seed, a tick at the median; None without scores."""
    known = [one for one in experiment.trainings if one.values(REWARD.key)]
    if not known:
        return None
    figure, panels = new_figure(1.2 + 0.3 * len(known), 1, len(MEASURES), sharey=True)
    for panel, measure in zip(panels, MEASURES, strict=True):
        positions = [references.position(training, measure) for training in known]
        for row, (training, position) in enumerate(zip(known, positions, strict=True)):
            _draw_row(panel, row, training.values(measure.key), looks[training.name].colour)
            _mark_position(panel, row, position)
        _mark_first(panel, experiment.trainings[0], measure)
        values = [value for one in known for value in one.values(measure.key).values()]
        if measure is ANGLE:
            widen(panel, "x", [*values, *(one for one in positions if one is not None)])
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


def _mark_position(panel: Axes, row: int, score: float | None) -> None:
    """What the position-only policy scores at the row's own task."""
    if score is not None:
        panel.plot(score, row, "D", mfc="white", color=GREY, ms=4.5, zorder=1.5, label=POSITION)


def _mark_first(panel: Axes, first: Training, measure: Measure) -> None:
    """A line at the training that the others are compared with."""
    known = spread(first.values(measure.key).values())
    if known is not None:
        label = f"median of {first.label}"
        panel.axvline(known.median, color=LEVEL, linewidth=1.0, zorder=1, label=label)
