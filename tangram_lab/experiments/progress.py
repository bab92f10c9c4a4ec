"""What a study tells while it runs: one bar over everything, one line for each running job."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from master.status import duration
from tangram_lab.experiments.jobs import Job


class StudyProgress:
    """Bars on a terminal; elsewhere a line for each job that is done."""

    def __init__(self, console: Console, total: int, done: int) -> None:
        """Nothing is shown before it is entered.

        Args:
            console: where to.
            total: number of jobs.
            done: how many of them were done before.
        """
        self._console, self._total, self._done = console, total, done
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[count]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        # What was done before took no time now: the estimate is made from the rest.
        self._all = self._bars.add_task("all jobs", total=total - done, count=f"{done}/{total}")
        self._tasks: dict[Job, TaskID] = {}

    def __enter__(self) -> "StudyProgress":
        self._bars.start()
        self.say(f"{self._done} of {self._total} jobs were done before")
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def say(self, text: str) -> None:
        """A line for the user."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def started(self, job: Job) -> None:
        """A job runs."""
        total = bound(job)[1]
        self._tasks[job] = self._bars.add_task(f"  {job.name}", total=total, count="")

    def look(self, running: Sequence[Job]) -> None:
        """Show how far the running trainings are."""
        if self._bars.disable:
            return
        for job in running:
            last = _last_evaluation(job)
            unit, total = bound(job)
            if last and total is not None:
                done = int(last[unit])
                text = f"{done:,}/{total:,} {unit}, mean reward {last['mean_reward']:.3f}"
                self._bars.update(self._tasks[job], completed=done, count=text)

    def finished(self, job: Job, result: Mapping[str, Any]) -> None:
        """A job came to its end."""
        self._done += 1
        self._bars.update(self._all, advance=1, count=f"{self._done}/{self._total}")
        self.say(f"[{self._done}/{self._total}] {job.name}: {_outcome(result)}")

    def ended(self, job: Job) -> None:
        """A job runs no longer."""
        self._bars.remove_task(self._tasks.pop(job))


def bound(job: Job) -> tuple[str, int | None]:
    """What ends a training, updates or episodes, and after how many; None for a test."""
    for unit in ("updates", "episodes"):
        limit = job.settings.get(f"max_{unit}", 0) if job.trains else 0
        if isinstance(limit, int) and limit:
            return unit, limit
    return "updates", None


def _last_evaluation(job: Job) -> dict[str, Any]:
    """The last line of a training's curve; empty where there is none."""
    try:
        text = (job.run_dir / "curve.jsonl").read_text(encoding="utf-8")
        last = json.loads(text.splitlines()[-1])
        return last if {"updates", "episodes", "mean_reward"} <= set(last) else {}
    except (OSError, ValueError, IndexError, TypeError):
        return {}


def _outcome(result: Mapping[str, Any]) -> str:
    reward, angle = result.get("mean_reward"), result.get("angle_error_deg_median")
    if reward is None or angle is None:
        return "done, without scores"
    text = f"mean reward {reward:.3f}, angle error {angle:.2f} deg"
    seconds = result.get("train_s")
    return text if seconds is None else f"{text}, {duration(seconds)} of training"
