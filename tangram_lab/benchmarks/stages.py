"""The benchmarks by name (stages), and the tables and files that they write."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict

import torch

from tangram_core.run.process import keep_memory
from tangram_lab.benchmarks.measure import Row, page, show, write
from tangram_lab.benchmarks.speed.fetch import TASKS, Match, measure_fetch
from tangram_lab.benchmarks.speed.learner import measure_gpu, measure_learner
from tangram_lab.benchmarks.speed.scaling import measure_scaling

STAGES: dict[str, Callable[[argparse.Namespace], Sequence[Row]]] = {
    "learner": lambda given: measure_learner(given.runs),
    "scaling": lambda given: measure_scaling(given.runs),
    "fetch": lambda given: measure_fetch(_matches(given), given.rows),
    "gpu": lambda given: measure_gpu(given.runs, profile=given.profile == "true"),
}


def run_stages(given: argparse.Namespace) -> int:
    """Measure one stage or all; return exit status 0, even if a target was missed.

    With `out`, write the results as JSON and the table as Markdown beside it.
    """
    torch.set_num_threads(1)  # this and the next line: as in masters and workers
    keep_memory()
    names = ["learner", "scaling"] if given.kind == "all" else [given.kind]
    rows = [row for name in names for row in STAGES[name](given)]
    title, cells = f"{given.kind}: medians, one thread each", [cells_of(row) for row in rows]
    show(title, cells)
    missed = [f"{row.stage}: {row.case}" for row in rows if row.held is False]
    if missed:
        print("missed the target:", *missed, sep="\n  ")
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.with_suffix(".md").write_text(page(title, cells))
    settings = {name: value for name, value in vars(given).items() if name not in ("out", "rows")}
    if given.kind == "gpu":
        settings["card"] = torch.cuda.get_device_name()
    write(given.out, {"settings": settings, "rows": [asdict(row) for row in rows]})
    return 0


def _matches(given: argparse.Namespace) -> list[Match]:
    """All tasks with the first seed, then all tasks with the next seed."""
    tasks = TASKS if given.id is None else (given.id,)
    rest = (given.minutes, given.agent, given.workers)
    return [Match(task, seed, *rest) for seed in range(given.seeds) for task in tasks]


def cells_of(row: Row) -> dict[str, object]:
    """Column -> content of the row in the table."""
    spread = "" if row.least is None else f"{row.least:,.3g} - {row.most:,.3g}"
    held = {None: "", True: "yes", False: "NO"}[row.held]
    return {
        "stage": row.stage,
        "case": row.case,
        "unit": row.unit,
        "ours": row.ours,
        "against": row.against,
        "theirs": "" if row.theirs is None else row.theirs,
        "ratio": "" if row.ratio is None else row.ratio,
        "least - most": spread,
        "target": row.target,
        "held": held,
    }
