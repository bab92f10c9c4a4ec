"""Tables and figures of a study, from its CSV file; one table for a folder of runs."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as Canvas

from tangram_agent.runs import read_config
from tangram_core.errors import RunError
from tangram_core.scores import decimal
from tangram_core.store.files import write_whole
from tangram_core.store.stored import CONFIG
from tangram_lab.experiments.rows import AGENT, RUN, SCORES, Spread, of_a_study, read_rows, spreads
from tangram_lab.experiments.runner import read_json
from tangram_lab.experiments.studies import Figure, Study, read_studies
from tangram_lab.figures import COLOURS, legend_below, new_figure, save

GRID = 200  # points of a mean curve over seeds
NAMED = 6  # at most so many settings in the label of a row
LABELS = {
    "mean_reward": "mean reward",
    "mean_reward_dense": "mean reward, dense",
    "iou": "IoU",
    "angle_error_deg": "angle error, °",
    "position_error": "position error",
    "doubly_used": "doubly used",
    "ms_per_choice": "CPU ms an action",
    "train_seconds": "training, s",
}
WHOLE = ("updates", "episodes", "parameters", "train_seconds")  # numbers without decimals
RIVALS = {"position only": "--", "exact": ":"}  # rival -> line style of its score beside curves
DASHES = ("-.", (0, (1, 3)))  # line styles of scores that others report
AXES = {  # x axis of curves -> label, and where it turns from linear to logarithmic
    "job": ("episodes of the paper", np.inf),
    "simulations": ("simulations", 1000),
    "episodes": ("episodes", 1000),
    "train_seconds": ("seconds of training", 30),
}


# Tables


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; all columns but the first are aligned right, as numbers."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def shown(spread: Spread, measure: str) -> str:
    """A spread as text: median (least to most), or one number if all seeds agree."""

    def text(value: float) -> str:
        return f"{value:,.0f}" if measure in WHOLE else decimal(value, 4)

    median, least, most = map(text, spread)
    return median if least == most else f"{median} ({least} to {most})"


def page(title: str, csv: str, rows: pd.DataFrame) -> str:
    """A Markdown page with a table of all trainings and tests, each followed by its rivals."""
    measures = [name for name in (*SCORES, *RUN) if name in rows and rows[name].notna().any()]
    found = {name: spreads(rows, name) for name in measures}
    lines = []
    for key, group in rows.groupby(["training", "test", "policy"], sort=False):
        training, test, policy = map(str, key)
        own = policy == AGENT
        cells = [
            shown(found[name][training, test, policy], name)
            if (training, test, policy) in found[name]
            else ""
            for name in measures
        ]
        what = str(group["label"].iloc[0]) if own else f"*{policy}*"
        seeds = str(group["seed"].nunique()) if own else ""
        lines.append([what, f"`{training}`", test, seeds, *cells])
    head = ["agent or rival", "training", "test", "seeds"]
    commits = ", ".join(sorted(rows["commit"].dropna().unique()))
    return (
        f"# {title}\n\nMedian over the seeds (least to most), in fixed tests without exploration. "
        f"Below each agent are its rivals, which learned nothing and played the same tests. "
        f"Every run is a row of [{csv}]({csv}), made at commits {commits}.\n\n"
        + table([*head, *(LABELS.get(name, name) for name in measures)], lines)
    )


# Figures


def draw(figure: Figure, rows: pd.DataFrame, curves: pd.DataFrame | None) -> Canvas:
    """Draw one figure from the rows and the learning curves of a study.

    Raises:
        RunError: the rows or the curves of its trainings are missing.
    """
    names = [name for name in figure.trainings if name in {*rows["training"]}]
    if not names or (figure.kind == "curves" and curves is None):
        raise RunError(f"there are no results to draw '{figure.title}': run its trainings first")
    labels = dict(zip(rows["training"], rows["label"], strict=True))
    if figure.kind == "curves" and curves is not None:
        canvas = _curves(figure, names, labels, rows, curves)
    elif figure.kind == "tests":
        canvas = _tests(figure, names, labels, rows)
    else:
        canvas = _seeds(figure, names, labels, rows)
    canvas.suptitle(figure.title, fontsize=10)
    return canvas


def _curves(
    figure: Figure,
    names: Sequence[str],
    labels: dict[str, str],
    rows: pd.DataFrame,
    curves: pd.DataFrame,
) -> Canvas:
    """Learning curves in two panels: median over the seeds, and a band from least to most."""
    canvas, panels = new_figure(4.2, 2, sharey=True)
    count = curves["episodes"]
    whole = curves.assign(job=count / max(figure.job, 1), simulations=count)
    columns = ("job", "simulations") if figure.job else ("episodes", "train_seconds")
    for panel, x in zip(panels, columns, strict=True):
        for name, colour in zip(names, COLOURS, strict=False):
            own = whole[whole["training"] == name]
            every = [one.sort_values(x) for _, one in own.groupby("seed")]
            grid = np.linspace(0.0, min(one[x].max() for one in every), GRID)
            lines = np.stack([np.interp(grid, one[x], one[figure.measure]) for one in every])
            least, middle, most = np.percentile(lines, (0, 50, 100), axis=0)
            panel.plot(grid, middle, color=colour, label=labels[name])
            panel.fill_between(grid, least, most, color=colour, alpha=0.15)
        text, linear = AXES[x]
        panel.set(xlabel=text, xlim=(0.0, None))
        last = panel.get_xlim()[1]
        if last > 10.0 * linear:
            panel.set_xscale("symlog", linthresh=linear)
            decades = 10.0 ** np.arange(1, 12)
            # Labels of smaller decades would overlap on the linear part of the axis.
            panel.set_xticks([0.0, *decades[(decades >= linear) & (decades <= last)]])
        for (name, levels), dash in zip(figure.reported.items(), DASHES, strict=False):
            panel.axhline(levels[0], color="#111827", linestyle=dash, label=name)
        for policy, dash in RIVALS.items():
            own = rows[(rows["policy"] == policy) & rows["training"].isin(names[:1])]
            if len(own):
                level = own[figure.measure].iloc[0]
                panel.axhline(level, color="#6B7280", linestyle=dash, label=policy)
    panels[0].set(ylabel=LABELS[figure.measure])
    legend_below(canvas, panels[0])
    return canvas


def _tests(
    figure: Figure, names: Sequence[str], labels: dict[str, str], rows: pd.DataFrame
) -> Canvas:
    """Scores by test: the median, with bars from least to most; rivals as dotted lines."""
    canvas, (panel, *_) = new_figure(4.4)
    place = np.arange(len(figure.tests))
    found = spreads(rows, figure.measure)
    for name, colour in zip(names, COLOURS, strict=False):
        known = [found[name, test, AGENT] for test in figure.tests]
        middle, least, most = np.array(known).T
        bars = [middle - least, most - middle]
        panel.errorbar(place, middle, bars, color=colour, marker="o", capsize=3, label=labels[name])
    for policy in dict.fromkeys(rows["policy"]):
        levels = [found.get((names[0], test, policy)) for test in figure.tests]
        if policy not in (AGENT, "random") and all(levels):
            middle = np.array([one.median for one in levels if one])
            panel.plot(place, middle, "k:", marker=".", alpha=0.6, label=f"{policy} (rival)")
    for name, reported in figure.reported.items():
        panel.plot(place, reported, "k--", marker="x", label=name)
    texts = [test.replace("_", " ") for test in figure.tests]
    panel.set_xticks(place, texts, rotation=30 if len(texts) > 6 else 0, ha="center")
    panel.set(ylabel=LABELS[figure.measure])
    legend_below(canvas, panel)
    return canvas


def _seeds(
    figure: Figure, names: Sequence[str], labels: dict[str, str], rows: pd.DataFrame
) -> Canvas:
    """Scores by training: dots for seeds, a tick for the median, a diamond for the rival."""
    canvas, (panel, *_) = new_figure(0.9 + 0.32 * len(names))
    here = rows[rows["test"] == figure.test]
    for place, (name, colour) in enumerate(zip(names, COLOURS * 2, strict=False)):
        own = here[(here["training"] == name) & (here["policy"] == AGENT)][figure.measure]
        panel.scatter(own, np.full(len(own), place), s=18, color=colour, alpha=0.6)
        panel.plot([own.median()] * 2, [place - 0.3, place + 0.3], color=colour, linewidth=2)
        rival = here[(here["training"] == name) & (here["policy"] == "position only")]
        panel.scatter(
            rival[figure.measure], np.full(len(rival), place), marker="D", s=22, color="#6B7280"
        )
    panel.set_yticks(range(len(names)), [labels[name] for name in names])
    panel.invert_yaxis()
    turns = bool((here["policy"] == "position only").any())
    diamond = " (diamond: a formula that never turns)" * turns
    panel.set(xlabel=f"{LABELS[figure.measure]}{diamond}")
    return canvas


# Reports


def write_report(runs: Path, out: Path) -> Iterator[Path]:
    """Write all tables and figures of a folder; yield each file as it is written.

    Raises:
        RunError: the folder has neither runs nor the CSV of a study, or a file cannot be read.
    """
    files = [path for path in sorted(runs.glob("*.csv")) if of_a_study(read_rows(path))]
    studies = read_studies().studies
    for path in files:
        named = studies.get(path.stem, Study(path.stem.replace("_", " ").capitalize(), 0, {}))
        yield from write_study(path.stem, named, path, out)
    if not files:
        yield write_runs(runs, out)


def write_study(name: str, study: Study, csv: Path, out: Path) -> Iterator[Path]:
    """Write the page and the figures of a study; figures without rows are left out.

    Raises:
        RunError: the CSV cannot be read.
    """
    rows = read_rows(csv)
    curve_file = csv.with_name(f"{name}_curves.csv")
    curves = read_rows(curve_file) if curve_file.exists() else None
    target = out / f"{name}.md"
    write_whole(target, page(study.title, csv.name, rows).encode())
    yield target
    for key, figure in study.figures.items():
        try:
            canvas = draw(figure, rows, curves)
        except RunError:
            continue
        target = out / f"{name}_{key}.png"
        save(canvas, target)
        yield target


def write_runs(folder: Path, out: Path) -> Path:
    """Write one table of a folder of runs, such as a sweep; runs that differ in seed share a row.

    Raises:
        RunError: the folder has no runs.
    """
    configs = sorted(folder.glob(f"*/{CONFIG}"))
    if not configs:
        raise RunError(f"{folder} has neither runs nor the CSV of a study: set runs=... to another")
    found = []
    for path in configs:
        result = read_json(path.parent / "result.json")
        told = dict(_flat(read_config(path)))
        seed = told.pop("seed", None)
        for name in ("run_dir", "resume"):
            told.pop(name, None)
        found.append((told, seed, result))
    names = {name for told, _, _ in found for name in told}
    differ = [n for n in sorted(names) if len({repr(told.get(n)) for told, _, _ in found}) > 1]
    first = ["agent.name"] * ("agent.name" not in differ)
    rows = pd.DataFrame(
        {
            "label": ", ".join(f"{n}={told.get(n)}" for n in (*first, *differ[:NAMED])),
            "all": repr([told.get(n) for n in differ]),
            "seed": seed,
            "finished": "ended_by" in result,
            **{name: result.get(key) for name, key in SCORES.items()},
            **{name: result.get(name) for name in RUN},
            "train_seconds": result.get("train_s"),
        }
        for told, seed, result in found
    )
    measures = [name for name in (*SCORES, *RUN) if pd.to_numeric(rows[name]).notna().any()]
    lines = []
    for _, group in rows.groupby("all", sort=False):
        cells = [f"{int(group['finished'].sum())} of {len(group)}"]
        for name in measures:
            values = pd.to_numeric(group[name]).dropna()
            spread = Spread(values.median(), values.min(), values.max())
            cells.append(shown(spread, name) if len(values) else "")
        lines.append([str(group["label"].iloc[0]), *cells])
    head = ["training", "seeds", *(LABELS.get(name, name) for name in measures)]
    text = f"# Runs of {folder.name}\n\nMedian over the seeds (least to most), of each run's last "
    target = out / "tables.md"
    write_whole(target, (text + "evaluation.\n\n" + table(head, lines)).encode())
    return target


def _flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of every setting in nested sections."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
