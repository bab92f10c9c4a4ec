"""The result of a run in words, from its result.json."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tangram_core.errors import UNREADABLE, RunError
from tangram_core.scores import read

FILE_NAME = "result.json"
BOUNDS = ("max_hours", "max_episodes", "max_updates")
ROWS = 6  # scores that are shown
CTRL_C = {"SIGINT": "Ctrl-C (SIGINT)"}


def read_outcome(path: Path) -> dict[str, Any]:
    """Read a result.json; RunError if `outcome_rows` or `bound_of` cannot use it."""
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
        outcome_rows(result)
        bound_of(result)
    except UNREADABLE as error:
        raise RunError(
            f"{path} is no result of a run ({error!r}): name another folder, or "
            "delete the file: then resume=auto goes on from the last checkpoint"
        ) from None
    return dict(result)


def outcome_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Rows (name, text) that show a result to people."""
    scores = read(result["scores"])
    shown = [score for score in scores[:ROWS] if result[score.name] is not None] or scores[:1]
    rows = [(score.label, score.shown(result[score.name])) for score in shown]
    if result["scored_updates"] is None:
        rows = [("scores", "none: no evaluator took part; tangram-eval scores a finished run")]
    elif result["scored_updates"] != result["updates"]:
        rows.append(("scored", f"weights after {plural(result['scored_updates'], 'update')}"))
    return [
        *rows,
        ("episodes", f"{result['episodes']:,}"),
        ("updates", f"{result['updates']:,}"),
        ("time", f"{duration(result['train_s'])} of training, {duration(result['wall_s'])} in all"),
        ("ended by", CTRL_C.get(result["ended_by"], result["ended_by"])),
    ]


def bound_of(result: Mapping[str, Any]) -> tuple[str, float]:
    """The setting that ended a run and the value reached; ("", 0.0) if a signal ended the run."""
    if not result["ended_by"].isprintable():
        raise ValueError("ended_by is no plain text")
    name, _, reached = result["ended_by"].partition("=")
    return (name, float(reached)) if name in BOUNDS else ("", 0.0)


def plural(count: float, noun: str) -> str:
    """A count with its noun, as in 1 worker, 2 workers."""
    return f"{count:,.0f} {noun}" if count == 1 else f"{count:,.0f} {noun}s"


def duration(seconds: float) -> str:
    """A duration as 0:07, 12:34 or 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
