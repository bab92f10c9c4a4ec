"""Speed of two implementations, measured in turns, and their ratio with its spread."""

import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from master.watch.result import commit, processor, versions

SPAN_S = 0.5
# Does one portion of work and returns its amount, in the unit of the rate.
Work = Callable[[], float]


@dataclass(frozen=True)
class Row:
    """One comparison, or one number without a rival.

    Attributes:
        stage: name of the benchmark.
        case: what was measured.
        unit: unit of `ours` and `theirs`.
        ours: our median over the runs.
        against: name of the rival; empty without one.
        theirs: median of the rival; None without one.
        ratio: median over the runs of ours / theirs; None without a rival.
        least, most: smallest and largest ratio, or without a rival smallest and largest number.
        target: required bound of the ratio, or without a rival of `ours`; empty for none.
        held: whether the target is met; None without a target.
    """

    stage: str
    case: str
    unit: str
    ours: float
    against: str = ""
    theirs: float | None = None
    ratio: float | None = None
    least: float | None = None
    most: float | None = None
    target: str = ""
    held: bool | None = None


def rate(work: Work, span_s: float) -> float:
    """Units of work per second, measured over at least `span_s` seconds."""
    begin, count = time.perf_counter(), 0.0
    while (passed := time.perf_counter() - begin) < span_s:
        count += work()
    return count / passed


def rates(works: Mapping[str, Work], runs: int, span_s: float = SPAN_S) -> dict[str, list[float]]:
    """Measure every rate `runs` times, in turns, so other load on the machine affects all alike."""
    for work in works.values():
        work()  # warm up: compilation and other work that is done only once
    found: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(runs):
        for name, work in works.items():
            found[name].append(rate(work, span_s))
    return found


def row_of(
    labels: tuple[str, str, str],
    ours: Sequence[float],
    against: str = "",
    theirs: Sequence[float] | None = None,
    least: float | None = None,
) -> Row:
    """Make and print the row of one series of numbers, or of two that were measured in turns.

    Args:
        labels: stage, case and unit.
        ours: our numbers.
        against: name of the rival; empty without one.
        theirs: numbers of the rival, as many as `ours`; None without one.
        least: smallest value of ours / theirs, or without a rival of `ours`; None: no bound.
    """
    found, ratio = ours, None
    if theirs is not None:
        found = [mine / other for mine, other in zip(ours, theirs, strict=True)]
        ratio = statistics.median(found)
    return told(
        Row(
            *labels,
            ours=statistics.median(ours),
            against=against,
            theirs=None if theirs is None else statistics.median(theirs),
            ratio=ratio,
            least=min(found),
            most=max(found),
            target="" if least is None else f">= {least:g}",
            held=None if least is None else statistics.median(found) >= least,
        )
    )


def told(row: Row) -> Row:
    """Print a row at once, because the whole benchmark takes long; return the row."""
    ratio = "" if row.ratio is None else f", {row.ratio:.3g} times {row.against}"
    Console(stderr=True).print(
        f"{row.stage}: {row.case}: {row.ours:,.4g} {row.unit}{ratio}", highlight=False
    )
    return row


# Tables on the terminal, and JSON files with the origin of their numbers


def show(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows as a table; all have the same keys, its columns."""
    table = Table(title=title, title_justify="left")
    for name in rows[0]:
        table.add_column(name, justify="left" if isinstance(rows[0][name], str) else "right")
    for row in rows:
        table.add_row(*(_text(value) for value in row.values()))
    # Output that is no terminal gets a fixed width that fits all columns.
    Console(width=None if sys.stdout.isatty() else 220).print(table)


def page(title: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown page with a table of rows with equal keys."""
    lines = [f"# {title}", "", "| " + " | ".join(rows[0]) + " |", "|---" * len(rows[0]) + "|"]
    lines += ["| " + " | ".join(_text(value) for value in row.values()) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write(path: Path | None, content: Mapping[str, Any]) -> None:
    """Write results as JSON with command, commit, machine and versions; nothing if path is None."""
    if path is None:
        return
    source = {
        "command": " ".join(["tangram-bench", *sys.argv[1:]]),
        "commit": commit(),
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "system": platform.platform(),
        "versions": versions(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**source, **content}, indent=1) + "\n")
    Console().print(f"written: {path}", highlight=False)


def _text(value: Any) -> str:
    if not isinstance(value, float):
        return f"{value:,}" if isinstance(value, int) else str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
