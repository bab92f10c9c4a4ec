"""The rows of a study as CSV: one row for each test of each run, and one for each rival in it.

A rival is a policy that learned nothing and plays the same tests. Its seed is empty if it scored
the same in the runs of all seeds.
"""

import csv
import io
import os
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from tangram_core.errors import RunError

AGENT = "agent"
# Old name of a score, before version 0.2 -> new name. Version 0.2 still reads the old names.
OLD = {
    "raw_overlap": "coverage",
    "raw_overlap_p10": "coverage_p10",
    "share_solved": "solved",
    "share_solved_iou": "solved",
}
# Column -> name in the files of tangram-eval.
SCORES = {
    "mean_reward": "mean_reward",
    "mean_reward_dense": "mean_reward_dense",
    "coverage": "coverage",
    "solved": "solved",
    "iou": "iou",
    "angle_error_deg": "angle_error_deg_median",
    "position_error": "position_error_median",
    "wrong": "wrong",
    "doubly_used": "doubly_used",
    "blocked": "blocked",
    "pushes": "pushes",
    "ms_per_choice": "ms_per_choice",
}
RUN = ("updates", "episodes", "parameters", "train_seconds")  # columns about the training
LEVELS = {"reached_0.70": 0.70, "reached_0.75": 0.75}  # column -> mean reward, as in the paper
COLUMNS = (
    *("training", "label", "seed", "test", "policy", "commit", "tests"),
    *(*SCORES, "seconds_per_puzzle", *RUN, *LEVELS),
)
CURVE = ("training", "seed", "episodes", "updates", "train_seconds", *list(SCORES)[:2])
POINTS = 30  # at most so many points of a curve are written
DIGITS = 6  # significant digits of a written number

Row = Mapping[str, Any]


class Spread(NamedTuple):
    """Spread of a score over the seeds of a training, in one test."""

    median: float
    least: float
    most: float


def tell_of_old(names: Iterable[str], path: Path) -> list[str]:
    """The old names of scores among the names in a file; warn if there are any."""
    old = [name for name in names if name in OLD]
    if old:
        told = ", ".join(f"{name} is called {OLD[name]} now" for name in old)
        message = f"{path}: {told}; version 0.3 reads no old name"
        warnings.warn(message, FutureWarning, stacklevel=2)
    return old


def read_rows(path: Path) -> pd.DataFrame:
    """All rows of a CSV file, with old names of scores replaced.

    Raises:
        RunError: the file cannot be read.
    """
    try:
        found = pd.read_csv(path, dtype={"training": str, "test": str, "commit": str})
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: cannot be read ({error}): restore it, or delete it") from None
    for name in tell_of_old(found.columns, path):
        column = found.pop(name)
        new = OLD[name]
        found[new] = found[new].combine_first(column) if new in found else column
    return found


def of_a_study(rows: pd.DataFrame) -> bool:
    """Whether a table has the columns of a study."""
    return {"training", "test", "policy"} <= {*rows.columns}


def spreads(rows: pd.DataFrame, measure: str) -> dict[tuple[str, str, str], Spread]:
    """(training, test, policy) -> spread of a score over the seeds, where it was measured."""
    known = rows.dropna(subset=[measure])
    groups = known.groupby(["training", "test", "policy"], sort=False)[measure]
    found = groups.agg(["median", "min", "max"])
    return {
        key: Spread(*map(float, values))
        for key, values in zip(found.index, found.to_numpy(), strict=True)
    }


def rows_of(
    training: str, label: str, seed: int, test: str, result: Row, scores: Row, curve: Iterable[Row]
) -> list[dict[str, Any]]:
    """The rows of one test of one run: the row of the agent, then those of its rivals.

    Args:
        training, label, seed, test: values for these columns.
        result: content of the run's result.json.
        scores: content of the file that tangram-eval wrote.
        curve: evaluations during the training.
    """
    points = list(curve)
    tests = scores.get("episodes") or len(scores.get("puzzles", ())) * (scores.get("turns") or 1)
    same = {"training": training, "label": label, "seed": seed, "test": test}
    same |= {"commit": _short(result.get("commit") or ""), "tests": tests}
    agent = same | {"policy": AGENT} | {name: scores.get(key) for name, key in SCORES.items()}
    agent |= {"seconds_per_puzzle": scores.get("seconds_per_puzzle")}
    agent |= {name: result.get(name) for name in RUN} | {"train_seconds": result.get("train_s")}
    agent |= {name: _reached(points, level) for name, level in LEVELS.items()}
    rivals = [
        same | {"policy": name} | {column: row.get(key) for column, key in SCORES.items()}
        for name, row in scores.get("baselines", {}).items()
    ]
    return [agent, *rivals]


def _short(commit: str) -> str:
    """Seven digits of a commit, and "-dirty" if files differed from it."""
    return commit[:7] + commit[40:]


def _reached(curve: list[Row], level: float) -> str:
    """The two evaluations, in episodes, between which a mean reward was first reached."""
    before = 0
    for point in curve:
        score = point.get("mean_reward")
        if score is not None and score >= level:
            return f"{before} to {int(point['episodes'])}"
        before = int(point["episodes"])
    return ""


def curve_rows(training: str, seed: int, curve: list[Row]) -> list[dict[str, Any]]:
    """Rows for at most 30 evenly spaced points of a curve, with the first and the last."""
    last = len(curve) - 1
    count = min(len(curve), POINTS)
    picked = sorted({round(step * last / max(count - 1, 1)) for step in range(count)})
    same = {"training": training, "seed": seed}
    return [
        same | {name: curve[one].get("train_s" if name == "train_seconds" else name)
                for name in CURVE[2:]}
        for one in picked
    ]  # fmt: skip


def append(path: Path, columns: Iterable[str], rows: Iterable[Row]) -> None:
    """Append rows to a CSV file in one write; a new file begins with the header."""
    head = list(columns)
    if path.exists():
        with path.open(encoding="utf-8", newline="") as file:
            head = next(csv.reader(file), head)
    text = io.StringIO()
    writer = csv.DictWriter(text, head, restval="", extrasaction="ignore", lineterminator="\n")
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        writer.writeheader()
    old = {OLD[name]: name for name in head if name in OLD}  # an old file keeps its column names
    writer.writerows(
        {old.get(name, name): _written(value) for name, value in row.items()} for row in rows
    )
    with path.open("a", encoding="utf-8") as file:
        file.write(text.getvalue())
        file.flush()
        os.fsync(file.fileno())


def _written(value: object) -> object:
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def done(path: Path) -> set[tuple[str, int, str]]:
    """(training, seed, test) of all agent rows in a CSV file; empty without the file."""
    if not path.exists():
        return set()
    rows = read_rows(path)
    own = rows[rows["policy"] == AGENT]
    return {(t, int(s), k) for t, s, k in own[["training", "seed", "test"]].to_numpy()}
