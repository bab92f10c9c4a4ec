"""Performance profiles: which share of all runs, over all tasks alike, scores more than what."""

import numpy as np
from matplotlib.figure import Figure

from tangram_lab.experiments.report.numbers import REWARD
from tangram_lab.experiments.report.statistics import ENOUGH, profile
from tangram_lab.experiments.report.study import Experiment
from tangram_lab.experiments.report.style import COLOURS, legend_below, make_logarithmic, new_figure

LEVELS = 200
NEAREST = 1e-5  # to a perfect mean reward
SHORT_OF = "short of a perfect mean reward by no more than"


def draw_profile(experiment: Experiment) -> Figure | None:
    """Against how much a run falls short of 1; None where a training has too few seeds."""
    each = [one.values(REWARD.key, experiment.main_test) for one in experiment.trainings]
    common = set.intersection(*({*values} for values in each)) if each else set[int]()
    if len(common) < ENOUGH:
        return None
    scores = np.array([[values[seed] for values in each] for seed in sorted(common)])
    short = np.geomspace(NEAREST, 2.0, LEVELS)
    shares, (low, high) = profile(scores, 1.0 - short)
    figure, (panel,) = new_figure(3.4, 1, 1)
    label = f"{len(each)} trainings of {len(common)} seeds, 95 % interval"
    panel.plot(short, shares, color=COLOURS[0], label=label)
    panel.fill_between(short, low, high, color=COLOURS[0], alpha=0.18, linewidth=0)
    make_logarithmic(panel, "x")
    panel.set_xlabel(SHORT_OF)
    panel.set_ylabel("share of runs")
    panel.set_ylim(0.0, 1.05)
    legend_below(figure, panel)
    return figure
