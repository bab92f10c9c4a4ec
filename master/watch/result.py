"""The result of a run: result.json, and the final table for the user."""

import logging
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shutil import which
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from master.config import MasterConfig
from master.record.rundir import RunFolder
from master.watch.console import TEST, sturdy_console
from tangram_core.run.code import argument, code_of
from tangram_core.run.outcome import outcome_rows, read_outcome
from tangram_core.scores import Score, written
from tangram_core.wire.messages import RunStatus

ROOT = Path(__file__).resolve().parents[2]
log = logging.getLogger(__name__)

PACKAGES = ("tangram-rl", "torch", "numpy", "pyzmq", "pybullet")


def make_result(
    status: RunStatus,
    scores: Sequence[Score],
    facts: Mapping[str, Any],
    seed: int,
    reason: str,
) -> dict[str, Any]:
    """The content of result.json; scores are null if no evaluator sent any.

    `scored_updates` is the version of the scored weights; it equals `updates` for the final ones.
    `facts` come from `Trainer.facts`.
    """
    n = status.numbers
    scored = int(n["scored_updates"])
    return {
        **{score.name: n.get(TEST + score.name) for score in scores},
        "scores": written(scores),
        "test_episodes": n.get(f"{TEST}episodes"),
        "scored_updates": scored if scored >= 0 else None,
        **{name: int(n[name]) for name in ("episodes", "transitions", "updates")},
        **{name: round(n[name], 3) for name in ("wall_s", "train_s")},
        "ended_by": reason,
        "seed": seed,
        **facts,
        "workers": int(n["most_players"]),
        "run_id": status.texts["run_id"],
        "versions": versions(),
        "commit": commit(),
        "host": platform.node(),
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
    }


def show_result(
    console: Console,
    folder: RunFolder,
    result: Mapping[str, Any],
    code: Mapping[str, str],
    go_on: str = "",
) -> None:
    """Print the final table, the paths of the results, and commands to use them.

    `go_on` is the command that resumes the run; it is shown if a signal ended the run.
    """
    table = Table(show_header=False, box=None, padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(no_wrap=True)
    for name, text in outcome_rows(result):
        table.add_row(Text(name), Text(text))
    console.print()
    console.print(table)
    console.print()
    curves, where = _installed("tensorboard"), shlex.quote(str(folder.tensorboard))
    paths = [("run folder", str(folder.path)), ("curves", f"{curves} --logdir {where}")]
    run = {"run_dir": folder.path}
    if folder.picture.exists():  # so the task can draw episodes
        paths.insert(1, ("picture", str(folder.picture)))
        watch = command_line("tangram-play", {**run, "out": folder.path / "play.gif", **code})
        paths.append(("watch it play", watch))
    else:
        paths.append(("score it", command_line("tangram-eval", {**run, **code})))
    if go_on and result["ended_by"].startswith("SIG"):
        paths.append(("go on", go_on))
    for name, text in paths:
        # Long paths stay whole, so that they can be copied.
        console.print(f"  {name:<15} {text}", soft_wrap=True, markup=False, highlight=False)


def show_finished(folder: RunFolder, log_format: str, code: Mapping[str, str]) -> None:
    """Show the result of a run that was to be resumed but is already complete."""
    result = read_outcome(folder.result)
    said = f"{folder.path} has finished ({result['ended_by']}): nothing is changed; set a higher "
    said += "bound to go on"
    if log_format == "json":
        log.info("%s", said, extra={"event": "result", **result})
        return
    console = sturdy_console(sys.stdout)
    console.print(said, soft_wrap=True, markup=False, highlight=False)
    show_result(console, folder, result, code)


def command_line(name: str, settings: Mapping[str, object]) -> str:
    """A command with settings, quoted for a shell."""
    return " ".join([_installed(name), *(argument(*pair) for pair in settings.items())])


def go_on_command(folder: RunFolder, launched: bool) -> str:
    """The command that resumes a run, with the settings that `from_config` does not load.

    The settings come from config.yaml, because a launched master does not know `workers`.
    """
    given = folder.read_config()
    names = ("seed", "max_hours", "max_episodes", "max_updates", "workers")
    settings = {
        "run_dir": folder.path,
        "from_config": folder.config,
        "resume": "auto",
        **{name: given[name] for name in names if given[name] != getattr(MasterConfig, name)},
        **code_of(given),
    }
    return command_line("tangram-train" if launched else "tangram-master", settings)


def _installed(name: str) -> str:
    """A command as a shell can find it: its name, or its path if the environment is not active."""
    return name if which(name) else shlex.quote(str(Path(sys.executable).with_name(name)))


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that affect the results."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def commit(root: Path = ROOT) -> str | None:
    """Git commit of a source tree, `-dirty` if not only results were changed; None without git."""
    if not (root / ".git").exists():
        return None

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words]
        return subprocess.check_output(command, text=True, stderr=subprocess.DEVNULL, timeout=10)

    try:
        changed = git("diff", "--name-only", "HEAD", "--", ":!docs/results")
        return git("rev-parse", "HEAD").strip() + "-dirty" * bool(changed)
    except (OSError, subprocess.SubprocessError):
        return None


def processor() -> str:
    """The name of the processor, as far as the system knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
