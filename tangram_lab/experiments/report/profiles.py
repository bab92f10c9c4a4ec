"""Performance profiles: which share of an agent's runs scores more than what."""

import numpy as np
from matplotlib.figure import Figure

from tangram_lab.experiments.report.numbers import REWARD
from tangram_lab.experiments.report.references import task_of
from tangram_lab.experiments.report.statistics import ENOUGH, profile
from tangram_lab.experiments.report.study import Experiment
from tangram_lab.experiments.report.style import COLOURS, legend_below, make_logarithmic, new_figure

LEVELS = 60
NEAREST = 1e-4  # to a perfect mean reward
SHORT_OF = "short of a perfect mean reward by no more than"


def draw_profile(experiment: Experiment) -> Figure | None:
    """Against how much a run falls short of 1; None where a training has too few seeds.

    A line for each training; trainings of which no two have the same task are one agent's, and one
    line.
    """
    each = [one.values(REWARD.key, experiment.main_test) for one in experiment.trainings]
    common = set.intersection(*({*values} for values in each)) if each else set[int]()
    if len(common) < ENOUGH:
        return None
    scores = np.array([[values[seed] for values in each] for seed in sorted(common)])
    short = np.geomspace(NEAREST, 2.0, LEVELS)
    lines = _lines(experiment)
    figure, (panel,) = new_figure(3.0 + 0.1 * len(lines), 1, 1)
    for number, (label, columns) in enumerate(lines):
        shares, (low, high) = profile(scores[:, columns], 1.0 - short)
        colour = COLOURS[number % len(COLOURS)]
        panel.plot(short, shares, color=colour, label=label)
        panel.fill_between(short, low, high, color=colour, alpha=0.18, linewidth=0)
    make_logarithmic(panel, "x")
    panel.set_xlabel(SHORT_OF)
    panel.set_ylabel(f"share of {len(common)} seeds")
    panel.set_ylim(0.0, 1.05)
    legend_below(figure, panel, 2)
    return figure


def _lines(experiment: Experiment) -> list[tuple[str, list[int]]]:
    """Label and numbers of the trainings that a line is of."""
    trainings = experiment.trainings
    if len({task_of(one) for one in trainings}) == len(trainings) > 1:
        return [(f"all {len(trainings)} tasks alike", [*range(len(trainings))])]
    return [(one.label, [number]) for number, one in enumerate(trainings)]
