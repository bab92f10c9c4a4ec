"""What a run has come to: result.json and the last words to the user."""

import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shutil import which
from typing import Any

from rich.console import Console
from rich.table import Table

from master.children import override
from master.console import TEST, duration
from master.rundir import RunFolder
from master.trainer import Trainer
from tangram_agent.messages import RunStatus

PLAIN = re.compile(r"run_dir=[\w./-]+")
ROOT = Path(__file__).resolve().parent.parent
SCORES = (
    "mean_reward",
    "mean_reward_dense",
    "mean_reward_camera",
    "raw_overlap",
    "raw_overlap_p10",
    "angle_error_deg_median",
    "angle_error_deg_p90",
    "position_error_median",
    "position_error_p90",
)
PACKAGES = ("tangram-rl", "torch", "numpy", "pyzmq", "pybullet")


def make_result(status: RunStatus, trainer: Trainer, seed: int, reason: str) -> dict[str, Any]:
    """The content of result.json; scores are null where no evaluator sent any.

    `scored_updates` tells which weights the scores are of: the final ones if it equals `updates`.

    Args:
        status: at the end of the run.
        trainer: what has learned.
        seed: of the run.
        reason: of its end.
    """
    setup, n = trainer.setup, status.numbers
    scored = int(n["scored_updates"])
    return {
        **{name: n.get(TEST + name) for name in SCORES},
        "test_episodes": n.get(f"{TEST}episodes"),
        "scored_updates": scored if scored >= 0 else None,
        **{name: int(n[name]) for name in ("episodes", "transitions", "updates")},
        **{name: round(n[name], 3) for name in ("wall_s", "train_s")},
        "ended_by": reason,
        "seed": seed,
        "agent": setup.agent.name,
        "net": setup.net.kind,
        "tokens": [shape.name for shape in setup.layout.shapes],
        "actions_per_token": setup.sim.actions_per_token,
        "reward": setup.reward.name,
        "backend": setup.sim.backend,
        "device": str(trainer.learner.device),
        "workers": int(n["most_players"]),
        "parameters": trainer.learner.parameters,
        "run_id": status.texts["run_id"],
        "versions": versions(),
        "commit": commit(),
        "host": platform.node(),
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
    }


def show_result(console: Console, folder: RunFolder, result: Mapping[str, Any]) -> None:
    """The final table, and where everything lies."""
    table = Table(show_header=False, box=None, padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(no_wrap=True)
    for name, text in _rows(result):
        table.add_row(name, text)
    console.print()
    console.print(table)
    console.print()
    paths = [("run folder", str(folder.path))]
    if folder.picture.exists():
        paths.append(("picture", str(folder.picture)))
    paths += [
        ("curves", f"{_command('tensorboard')} --logdir {shlex.quote(str(folder.tensorboard))}"),
        ("watch it play", f"{_command('tangram-play')} {_run_argument(folder.path)} out=play.gif"),
    ]
    for name, text in paths:
        # Long paths stay whole, so that they can be copied.
        console.print(f"  {name:<15} {text}", soft_wrap=True, markup=False, highlight=False)


def _command(name: str) -> str:
    """A command of this environment as a shell finds it, which may not have the environment on."""
    return name if which(name) else shlex.quote(str(Path(sys.executable).with_name(name)))


def _run_argument(path: Path) -> str:
    """What names the run on a command line; quoted for the shell and for the config if needed."""
    plain = f"run_dir={path}"
    return plain if PLAIN.fullmatch(plain) else shlex.quote(override("run_dir", str(path)))


def _rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [
        ("mean reward", f"{_text(result, 'mean_reward', '{:.3f}')} on exact polygons"),
        ("", f"{_text(result, 'mean_reward_camera', '{:.3f}')} in the camera's pictures"),
        ("raw overlap", _text(result, "raw_overlap", "{:.3f}")),
        ("angle error", _text(result, "angle_error_deg_median", "{:.2f}°") + " (median)"),
        ("position error", _text(result, "position_error_median", "{:.4f}") + " (median)"),
    ]
    if result["scored_updates"] is None:
        rows = [("scores", "none came from an evaluator")]
    elif result["scored_updates"] != result["updates"]:
        rows.append(("scored", f"weights after {result['scored_updates']:,} updates"))
    return [
        *rows,
        ("episodes", f"{result['episodes']:,}"),
        ("updates", f"{result['updates']:,}"),
        ("time", f"{duration(result['train_s'])} of training, {duration(result['wall_s'])} in all"),
        ("ended by", result["ended_by"]),
    ]


def _text(result: Mapping[str, Any], name: str, pattern: str) -> str:
    value = result[name]
    return "-" if value is None else pattern.format(value)


def versions() -> dict[str, str]:
    """Python and the packages that decide the numbers."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def commit(root: Path = ROOT) -> str | None:
    """The commit of the source tree that runs, `-dirty` if it was changed; None elsewhere."""
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None


def processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
