"""Figures of rankings: final scores, training by training, a dot for every seed."""

from collections.abc import Callable, Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.report.markdown import ANGLE, REWARD, Measure
from experiments.report.numbers import spread
from experiments.report.references import POSITION, References
from experiments.report.study import Experiment, Training
from experiments.report.style import GREY, LEVEL, Look, legend_below, new_figure

WIDE = 30.0  # most / least of values that need a logarithmic axis
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
        for row, training in enumerate(known):
            _draw_row(panel, row, training.values(measure.key), looks[training.name].colour)
            _mark_position(panel, row, references.position(training, measure))
        _mark_first(panel, experiment.trainings[0], measure)
        values = [value for one in known for value in one.values(measure.key).values()]
        _widen(panel.set_xscale, values)
        panel.set_xlabel(measure.axis)
        panel.grid(axis="y", visible=False)
    panels[0].set_yticks(range(len(known)), [one.label for one in known])
    panels[0].set_ylim(len(known) - 0.4, -0.6)
    legend_below(figure, panels[0])
    return figure


def _draw_row(panel: Axes, row: int, values: Mapping[int, float], colour: str) -> None:
    known = spread(values.values())
    if known is None:
        return
    dots = list(values.values())
    panel.plot([known.least, known.most], [row, row], color=colour, linewidth=1.2, alpha=0.5)
    panel.plot(
        dots, [row] * len(dots), "o", color=colour, alpha=0.75, ms=5, mew=0, label="one seed"
    )
    panel.plot(known.median, row, "|", color=colour, ms=14, mew=2.2, label="median of the seeds")


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


def _widen(set_scale: Callable[[str], object], values: Sequence[float]) -> None:
    if values and min(values) > 0.0 and max(values) / min(values) > WIDE:
        set_scale("log")
