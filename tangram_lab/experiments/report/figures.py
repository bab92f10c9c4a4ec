"""Figures: learning curves, sweeps over a quantity of the tests, and rankings.

Each is None where there is nothing to draw.
"""

import itertools
import textwrap
from collections.abc import Iterable, Mapping, Sequence
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
    rises_early,
    spread,
)
from tangram_lab.experiments.report.references import (
    EXACT,
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
    LINES,
    MARKERS,
    PALE,
    Look,
    legend_below,
    make_logarithmic,
    new_figure,
    thousands,
    widen,
)
from tangram_lab.experiments.report.tables import COMPARED, FORMULA, ORACLE

PER_ROW = 4
TICKS = 5
LIMIT = 1.08  # of rewards, with some room
TITLE_WIDTH = 30  # letters of a small panel's title
NOISE = "noise on the corners, standard deviation (% of the arena)"
ACTIONS = "actions in sequence (count)"
# What is changed of a plain world -> label of an axis.
CHANGED = {
    "sim.damping": "damping",
    "sim.action_noise": "noise on actions, standard deviation (full scales)",
    "sim.corner_noise": "noise on corners, standard deviation (arenas)",
    "sim.gain": "gain of x, y and turn",
}


# Agent and network -> colour, in every figure; others take the next ones.
PALETTE = {
    name: COLOURS[index]
    for index, name in enumerate(("paper mha", "paper mlp", "tangram mha", "tangram mlp"))
}


def looks(study: Study) -> dict[str, Look]:
    """Training -> look, the same in every figure.

    A colour is an agent with its network, whatever else a training changes; trainings of one colour
    differ in markers and dashes, within one figure of curves if that can be avoided.
    """
    groups = [
        {training.name for training in experiment.trainings}
        for experiment in sorted(study.experiments, key=lambda one: one.kind == "ranking")
    ]
    palette, colours = dict(PALETTE), itertools.cycle(COLOURS[len(PALETTE) :])
    chosen: dict[str, tuple[str, int]] = {}
    for group in groups:
        for one in (one for one in study.trainings if one.name in group):
            if one.name not in chosen:
                near = {o for other in groups if one.name in other for o in other} & set(chosen)
                colour = palette.get(kind := agent_and_network(one)) or next(colours)
                palette[kind] = colour
                taken = {chosen[other][1] for other in near if chosen[other][0] == colour}
                free = next(i for i in itertools.count() if i not in taken)
                chosen[one.name] = (colour, free)
    return {
        name: Look(colour, MARKERS[index % len(MARKERS)], DASHES[index % len(DASHES)])
        for name, (colour, index) in chosen.items()
    }


def agent_and_network(training: Training) -> str:
    """Such as `paper mlp`: as its settings name them, the defaults where they do not."""
    settings = dict(text.partition("=")[::2] for text in training.overrides)
    known = training.family if training.family in ("paper", "mlp") else "tangram"
    agent = settings.get("agent.name", settings.get("agent", known))
    network = settings.get("net.kind", settings.get("net", "mlp" if agent == "mlp" else "mha"))
    return f"{'paper' if agent == 'mlp' else agent} {network.partition('_')[0]}"


Part = Sequence[Training]


def curve_parts(study: Study, experiment: Experiment) -> list[Part]:
    """The trainings of each figure of learning curves."""
    return _parts(experiment, 1 + sum(r.name == POSITION for r in references(study, experiment)))


def sweep_parts(study: Study, experiment: Experiment) -> list[Part]:
    """The trainings of each figure of a sweep."""
    shown = (POSITION, EXACT)
    return _parts(experiment, sum(r.name in shown for r in references(study, experiment)))


def _parts(experiment: Experiment, others: int) -> list[Part]:
    """As few parts as give no panel more than `LINES` lines, `others` in each; alike in length."""
    known = experiment.trainings
    count = max(-(-len(known) // max(LINES - others, 1)), 1)
    ends = [round(len(known) * i / count) for i in range(count + 1)]
    return [known[first:last] for first, last in itertools.pairwise(ends)]


# Learning curves: mean and standard deviation over the seeds


def draw_curves(
    study: Study, experiment: Experiment, measure: Measure, part: Part
) -> Figure | None:
    """Three panels: against episodes, updates and minutes."""
    known = _with_curves(part, measure)
    if not known:
        return None
    look, axes = looks(study), (EPISODES, UPDATES, MINUTES)
    figure, panels = new_figure(3.9, 1, len(axes), sharey=True)
    for panel, axis in zip(panels, axes, strict=True):
        early = _rise_early(experiment.trainings, axis, measure)  # alike in each part
        for training in known:
            if found := _band(training, axis, measure, early):
                count = f"{found.seeds} seed{'s' * (found.seeds > 1)}"
                low_high = None
                if found.deviation is not None:
                    low_high = (found.mean - found.deviation, found.mean + found.deviation)
                x, label = found.x * axis.factor, f"{training.label}, {count}"
                _draw_line(panel, x, found.mean, low_high, look[training.name], label=label)
        dashes = itertools.cycle(DASHES[1:])
        for policy in references(study, experiment):
            score = policy.score(measure)
            if policy.name == POSITION and score is not None:
                _draw_level(panel, score, GREY, next(dashes), 1.2, f"{policy.label}: {score:.2f}")
        panel.axhline(1.0, color=LEVEL, linewidth=1.0, zorder=1, label="exact oracle: 1")
        panel.set_xlabel(axis.axis)
        _scale_updates(panel, early)
        if axis is EPISODES and measure is REWARD:
            _draw_papers(panel, experiment, known, look)
    panels[0].set_ylabel(measure.axis)
    panels[0].set_ylim(-LIMIT, LIMIT)  # the same in each part
    legend_below(figure, panels[0], 3)
    return figure


def _draw_papers(
    panel: Axes, experiment: Experiment, known: Part, look: Mapping[str, Look]
) -> None:
    """A diamond where the paper says that it got its mean reward, at the end if it does not."""
    for training in known:
        told = papers(experiment, training)
        if (score := told.get("mean_reward")) is not None:
            label = f"{training.label}, the paper's: {score:.2f}"
            style: dict[str, Any] = {"color": look[training.name].colour, "label": label}
            at = told.get("after", panel.get_xlim()[1])
            panel.plot(at, score, "D", mfc="white", ms=7, clip_on=False, zorder=4, **style)


def _scale_updates(panel: Axes, early: bool) -> None:
    """From 0 on, or logarithmic where the curves rise early."""
    if early:
        make_logarithmic(panel, "x")
        panel.margins(x=0)
    else:
        panel.set_xlim(left=0)
        panel.xaxis.set_major_formatter(thousands())
        panel.locator_params(axis="x", nbins=5)


def _with_curves(trainings: Part, measure: Measure) -> list[Training]:
    return [one for one in trainings if _band(one, UPDATES, measure)]


def _band(
    training: Training, axis: Measure, measure: Measure, logarithmic: bool = False
) -> Band | None:
    curves = [seed.curve for seed in training.finished]
    return band(curves, axis.key, measure.key, logarithmic)


def _rise_early(trainings: Part, axis: Measure, measure: Measure) -> bool:
    curves = (seed.curve for training in trainings for seed in training.finished)
    return rises_early(curves, axis.key, measure.key)


def _draw_line(panel: Axes, x: Any, y: Any, low_high: Any, look: Look, **style: Any) -> None:
    panel.plot(x, y, color=look.colour, linestyle=look.dash, **style)
    if low_high is not None:
        panel.fill_between(x, *low_high, color=look.colour, alpha=0.18, linewidth=0)


def _draw_level(panel: Axes, y: float, colour: str, dash: Any, width: float, label: str) -> None:
    panel.axhline(y, color=colour, linestyle=dash, linewidth=width, label=label)


def draw_single_seeds(study: Study, experiment: Experiment) -> Figure | None:
    """A small panel for each training: every seed's mean reward against updates.

    The range of the first training, which the others are compared with, stands in grey behind each.
    """
    known = _with_curves(experiment.trainings, REWARD)
    if not known:
        return None
    rows, columns = -(-len(known) // PER_ROW), min(PER_ROW, max(len(known), 3))
    figure, panels = new_figure(0.55 + 1.75 * rows, rows, columns, sharex=True, sharey=True)
    early = _rise_early(known, UPDATES, REWARD)
    first = _band(known[0], UPDATES, REWARD, early) if known[0] is experiment.trainings[0] else None
    for panel, training in zip(panels, known, strict=False):
        if training is not known[0] and first is not None:
            panel.fill_between(first.x, first.least, first.most, color=PALE, linewidth=2.0)
        for seed in training.finished:
            x, y = points(seed.curve, UPDATES.key, REWARD.key)
            panel.plot(x, y, color=looks(study)[training.name].colour, linewidth=1.1)
        title = "\n".join(textwrap.wrap(training.label, TITLE_WIDTH))
        panel.set_title(title, loc="left", fontsize=8.5)
        panel.xaxis.set_major_formatter(thousands())
    if early:
        make_logarithmic(panels[0], "x")
        panels[0].set_xlim(left=first.x[0] if first is not None else None)
    for panel in panels[len(known) :]:
        panel.set_visible(False)
    for panel in panels[max(len(known) - columns, 0) : len(known)]:
        panel.tick_params(labelbottom=True)  # the last one of its column
    figure.supxlabel(UPDATES.axis, fontsize=9.5, color="#374151")
    figure.supylabel(REWARD.axis, fontsize=9.5, color="#374151")
    return figure


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


def draw_sweep(study: Study, experiment: Experiment, sweep: Sweep, part: Part) -> Figure | None:
    """Two panels, mean reward and angle error: the median, and least to most."""
    places, tests = list(sweep.places), sweep.places.values()
    if not any(one.values(REWARD.key, test.name) for one in part for test in tests):
        return None
    look = looks(study)
    figure, panels = new_figure(3.8, 1, 2)
    for panel, measure in zip(panels, (REWARD, ANGLE), strict=True):
        for training in experiment.trainings:
            pairs = [
                (x, spread(training.values(measure.key, t.name).values()))
                for x, t in sweep.places.items()
            ]
            found = {x: one for x, one in pairs if one is not None}
            if not found:
                continue
            least, median, most = zip(*found.values(), strict=True)
            x = list(found)
            panel.update_datalim(np.column_stack([[*x, *x], [*least, *most]]))
            if training in part:
                style: dict[str, Any] = {"marker": look[training.name].marker, "markersize": 5.5}
                style["label"] = training.label
                _draw_line(panel, x, median, (least, most), look[training.name], **style)
        _draw_others(panel, study, experiment, sweep, measure, part)
        panel.set_xlabel(sweep.label)
        panel.set_ylabel(measure.axis)
        panel.margins(y=0.08)
        if measure is ANGLE:
            widen(panel, "y", [float(panel.dataLim.y0), float(panel.dataLim.y1)])
        panel.set_xticks(places, [f"{at:g}" for at in places])
    legend_below(figure, panels[0])
    return figure


def _draw_others(
    panel: Axes, study: Study, experiment: Experiment, sweep: Sweep, measure: Measure, part: Part
) -> None:
    """The paper's, position only (dashed), and the exact oracle, which sees the same noise."""

    def draw(values: Iterable[float | None], shape: str, **style: Any) -> None:
        known = {x: y for x, y in zip(sweep.places, values, strict=True) if y is not None}
        if known:
            panel.plot(list(known), list(known.values()), shape, **style)

    tests = sweep.places.values()
    for training in part if measure is REWARD else ():
        told = [papers_score(experiment, training, test) for test in tests]
        colour, label = looks(study)[training.name].colour, f"{training.label}, the paper's"
        draw(told, "D", mfc="white", ms=7, color=colour, label=label)
    for policy in references(study, experiment):
        told = [policy.score(measure, test) for test in tests]
        if policy.name == POSITION:
            draw(told, "--", linewidth=1.2, color=GREY, label=policy.label)
        elif policy.name == EXACT and measure is REWARD:
            draw(told, "-", linewidth=1.0, color=LEVEL, label=policy.label)


# Worlds that differ from a plain one in one thing


def changed_worlds(experiment: Experiment) -> dict[str, dict[float, Trial]]:
    """Setting -> its values -> tests that ask for it and for no other, from the plain one on."""
    found: dict[str, dict[float, Trial]] = {}
    plain: list[Trial] = []
    for test in experiment.tests:
        asked = {name: at for name in CHANGED if (at := test.asked(name)) is not None}
        if not asked:
            plain.append(test)
        elif len(asked) == 1:
            ((name, at),) = asked.items()
            found.setdefault(name, {})[at] = test
    for name, places in found.items():
        if plain:
            places.setdefault(float(name == "sim.gain"), plain[0])
    return {name: dict(sorted(one.items())) for name, one in found.items() if len(one) > 1}


def draw_worlds(study: Study, experiment: Experiment) -> Figure | None:
    """A panel for each thing that is changed: mean reward, the median and least to most."""
    found, look = changed_worlds(experiment), looks(study)
    known = [
        one
        for one in experiment.trainings
        if any(one.values(REWARD.key, t.name) for ts in found.values() for t in ts.values())
    ]
    if not known:
        return None
    rows = -(-len(found) // 2)
    figure, panels = new_figure(0.7 + 2.6 * rows, rows, min(len(found), 2), sharey=True)
    for panel, (setting, places) in zip(panels, found.items(), strict=False):
        for name, shape in ((ORACLE, "-"), ("fitted", ":"), (FORMULA, "--")):
            told = _compared(known, places, name)
            style: dict[str, Any] = {"color": LEVEL if name == ORACLE else GREY, "linewidth": 1.4}
            panel.plot(list(told), list(told.values()), shape, label=COMPARED[name], **style)
        for number, one in enumerate(known):
            pairs = [
                (x, spread(one.values(REWARD.key, t.name).values())) for x, t in places.items()
            ]
            own = {x: values for x, values in pairs if values is not None}
            if own:
                least, median, most = zip(*own.values(), strict=True)
                line = look[one.name]._replace(colour=COLOURS[number % len(COLOURS)])
                style = {"marker": line.marker, "markersize": 4.5, "label": one.label}
                _draw_line(panel, list(own), median, (least, most), line, **style)
        panel.set_xlabel(CHANGED[setting])
    for panel in panels[len(found) :]:
        panel.set_visible(False)
    for panel in panels[::2]:
        panel.set_ylabel(REWARD.axis)
    legend_below(figure, panels[0], 3)
    return figure


def _compared(known: Part, places: Mapping[float, Trial], policy: str) -> dict[float, float]:
    """Place -> what a policy scores there; where a world does as it is told, by the formula."""
    result: dict[float, float] = {}
    for at, test in places.items():
        for name in (policy, FORMULA):
            values = [
                v for one in known for v in one.compared(name, REWARD.key, test.name).values()
            ]
            if values:
                result[at] = values[0]
                break
    return result


# Rankings: final scores, training by training


def draw_ranking(study: Study, experiment: Experiment) -> Figure | None:
    """A row for each training, a dot for each seed, a tick at the median."""
    test = experiment.main_test
    known = [one for one in experiment.trainings if one.values(REWARD.key, test)]
    if not known:
        return None
    figure, panels = new_figure(1.2 + 0.3 * len(known), 1, 2, sharey=True)
    for panel, measure in zip(panels, (REWARD, ANGLE), strict=True):
        shown: list[float] = []
        for row, training in enumerate(known):
            values = list(training.values(measure.key, test).values())
            _draw_row(panel, row, values, looks(study)[training.name].colour)
            shown += values
            level = position(study, training).score(measure)
            if level is not None:
                style: dict[str, Any] = {"color": GREY, "ms": 4.5, "zorder": 1.5}
                panel.plot(level, row, "D", mfc="white", label=POSITION, **style)
                shown.append(level)
        first = experiment.trainings[0]
        if middle := spread(first.values(measure.key, test).values()):
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
