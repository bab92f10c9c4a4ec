"""Tables on the terminal and JSON files that say where their numbers come from."""

import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from master.result import commit, processor, versions


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
