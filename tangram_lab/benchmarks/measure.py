"""Rates of two ways to do the same, measured in turns, and their ratio with its spread."""

import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from master.watch.result import commit, processor, versions

SPAN_S = 0.5
# Does some of the work; returns how much of the unit that was.
Work = Callable[[], float]


@dataclass(frozen=True)
class Row:
    """One comparison, or one number beside its bound.

    Attributes:
        stage: the benchmark.
        case: what was measured.
        unit: of `ours` and `theirs`.
        ours: median over the runs.
        against: what it is compared with.
        theirs: its median; None where there is none.
        ratio: median over the runs of ours / theirs of one run.
        least, most: of that ratio.
        target: what the ratio (or, where there is none, `ours`) is to be; empty for none.
        held: whether it is; None where there is no target.
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

    def plain(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


@dataclass(frozen=True)
class Bound:
    """What a number is to be: at least `least`, or at most `most`."""

    least: float | None = None
    most: float | None = None

    def holds(self, value: float) -> bool:
        """Whether a value lies within."""
        low = self.least is None or value >= self.least
        return low and (self.most is None or value <= self.most)

    def __str__(self) -> str:
        parts = [f">= {self.least:g}"] if self.least is not None else []
        return ", ".join(parts + ([f"<= {self.most:g}"] if self.most is not None else []))


def rate(work: Work, span_s: float) -> float:
    """Units in a second, over at least `span_s`."""
    begin, count = time.perf_counter(), 0.0
    while (passed := time.perf_counter() - begin) < span_s:
        count += work()
    return count / passed


def rates(works: Mapping[str, Work], runs: int, span_s: float = SPAN_S) -> dict[str, list[float]]:
    """Rates of all, `runs` times, in turns: what else the machine does meets them all."""
    for work in works.values():
        work()  # whatever is only done once
    found: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(runs):
        for name, work in works.items():
            found[name].append(rate(work, span_s))
    return found


def compare(
    labels: tuple[str, str, str],
    ours: Work,
    theirs: tuple[str, Work],
    runs: int,
    bound: Bound | None = None,
) -> Row:
    """Measure both in turns.

    Args:
        labels: stage, case and unit.
        ours: our way.
        theirs: name and way of what it is compared with.
        runs: of both.
        bound: of the ratio.
    """
    found = rates({"ours": ours, "theirs": theirs[1]}, runs)
    return compared(labels, found["ours"], theirs[0], found["theirs"], bound)


def compared(
    labels: tuple[str, str, str],
    ours: Sequence[float],
    against: str,
    theirs: Sequence[float],
    bound: Bound | None = None,
) -> Row:
    """The row of numbers that were measured in turns."""
    ratios = [mine / other for mine, other in zip(ours, theirs, strict=True)]
    middle = statistics.median(ratios)
    return told(
        Row(
            *labels,
            ours=statistics.median(ours),
            against=against,
            theirs=statistics.median(theirs),
            ratio=middle,
            least=min(ratios),
            most=max(ratios),
            target="" if bound is None else str(bound),
            held=None if bound is None else bound.holds(middle),
        )
    )


def single(
    labels: tuple[str, str, str], values: Sequence[float], bound: Bound | None = None
) -> Row:
    """The row of a number that stands for itself; `least` and `most` are its own."""
    middle = statistics.median(values)
    return told(
        Row(
            *labels,
            ours=middle,
            least=min(values),
            most=max(values),
            target="" if bound is None else str(bound),
            held=None if bound is None else bound.holds(middle),
        )
    )


def told(row: Row) -> Row:
    """Print a row at once, since the whole takes long."""
    ratio = "" if row.ratio is None else f", {row.ratio:.3g} times {row.against}"
    Console(stderr=True).print(
        f"{row.stage}: {row.case}: {row.ours:,.4g} {row.unit}{ratio}", highlight=False
    )
    return row


# Tables on the terminal, and JSON files that say where their numbers come from


def show(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows with equal keys as a table."""
    table = Table(title=title, title_justify="left")
    for name in rows[0]:
        table.add_column(name, justify="left" if isinstance(rows[0][name], str) else "right")
    for row in rows:
        table.add_row(*(_text(value) for value in row.values()))
    # Wide enough for all columns also where the output goes into a file.
    Console(width=None if sys.stdout.isatty() else 220).print(table)


def page(title: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """The same table in Markdown."""
    lines = [f"# {title}", "", "| " + " | ".join(rows[0]) + " |", "|---" * len(rows[0]) + "|"]
    lines += ["| " + " | ".join(_text(value) for value in row.values()) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write(path: Path | None, content: Mapping[str, Any]) -> None:
    """Write results with the command, the commit, the machine and the versions; None: nothing."""
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
