"""What tangram-eval prints: scores of all policies, and of each puzzle."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

RUN = "this run"
MAX_LINES = 40  # of puzzles and of faults on the screen

Scores = dict[str, Any]  # numbers, and `coverage_each` of the episodes of several tokens

# Scores in the order of the table, with their labels and digits; the rest is only in the file.
_REWARDS = {
    "mean_reward": ("mean reward, polygons [-1, 1]", 3),
    "mean_reward_camera": ("mean reward, camera [-1, 1]", 3),
    "mean_train_reward": ("mean reward, as trained on", 3),
}
_ERRORS = {
    "position_error_median": ("position error, median", 4),
    "position_error_p90": ("position error, 90th percentile", 4),
    "angle_error_deg_median": ("angle error, median (degrees)", 2),
    "angle_error_deg_p90": ("angle error, 90th percentile", 2),
}
_ONE_TOKEN = {
    **_REWARDS,
    "raw_overlap": ("raw overlap [0, 1]", 3),
    "raw_overlap_p10": ("raw overlap, 10th percentile", 3),
    **_ERRORS,
}
# Short: a table of six policies should fit into 80 columns.
_SEVERAL = {
    "coverage": ("covered [0, 1]", 3),
    "raw_overlap_p10": ("covered, 10th perc.", 3),
    "iou": ("IoU", 3),
    "share_solved": ("solved, 95 % covered", 3),
    "mean_train_reward": ("reward as trained on", 3),
    "position_error_median": ("position, median", 4),
    "position_error_p90": ("position, 90th perc.", 4),
    "angle_error_deg_median": ("angle (°), median", 2),
    "angle_error_deg_p90": ("angle (°), 90th perc.", 2),
    "wrong": ("under another shape", 2),
    "doubly_used": ("under two tokens", 2),
    "refused": ("refused: was placed", 2),
    "blocked": ("blocked by others", 2),
    "actions_used": ("actions", 2),
    "seconds_per_puzzle": ("seconds", 3),
}


def scores_table(title: str, caption: str, scores: Mapping[str, Scores]) -> Table:
    """One column for each policy, one row for each score."""
    table = Table(title=title, caption=caption)
    table.add_column("", no_wrap=True)
    for name in scores:
        table.add_column(
            name.replace("=", " "), justify="right", style="bold" if name == RUN else "dim"
        )
    rows = _SEVERAL if "coverage" in scores[RUN] else _ONE_TOKEN
    for key, (label, digits) in rows.items():
        if key in scores[RUN]:
            table.add_row(label, *(f"{values[key]:.{digits}f}" for values in scores.values()))
    return table


def puzzles_table(puzzles: Sequence[Mapping[str, Any]], full: str | None) -> Table:
    """One line for each puzzle that the run played, the first `MAX_LINES` of them.

    Args:
        puzzles: scores of each.
        full: file that has all of them, if any.
    """
    left = len(puzzles) - MAX_LINES
    rest = f"and {left:,} more: all are in {full or 'the file that out= names'}"
    table = Table(caption=rest if left > 0 else None)
    for name in ("puzzle", "covered", "IoU", "wrong", "blocked", ""):
        table.add_column(name, justify="left" if name in ("puzzle", "") else "right")
    for one in puzzles[:MAX_LINES]:
        name = f"{one['name']} {one['degrees']:g}°" if one["degrees"] else str(one["name"])
        shares = (f"{one[key]:.3f}" for key in ("coverage", "iou"))
        solved = "solved" if one["solved"] else ""
        table.add_row(name, *shares, str(one["wrong"]), str(one["blocked"]), solved)
    return table


def print_faults(console: Console, faults: Sequence[str]) -> None:
    """One line for each puzzle that was left out."""
    for fault in faults[:MAX_LINES]:
        console.print(f"left out: {fault}", markup=False, soft_wrap=True)
    if len(faults) > MAX_LINES:
        console.print(f"left out: {len(faults) - MAX_LINES:,} more", markup=False)
