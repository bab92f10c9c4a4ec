"""Runs the jobs of a study, so many at a time; tells how far they are; goes on when one fails."""

import json
import os
import shlex
import signal
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
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

from master.children import Child, describe
from master.console import sturdy_console
from master.result import commit, processor, versions
from master.rundir import RunFolder
from master.signals import handling
from tangram_agent.files import write_whole
from tangram_agent.outcome import duration
from tangram_lab.experiments.fingerprints import (
    UPDATES,
    Fingerprint,
    differences,
    make_fingerprints,
)
from tangram_lab.experiments.jobs import Job, make_jobs, read_object
from tangram_lab.experiments.plan import (
    PLAN,
    StudyConfig,
    joined_plan,
    plan_content,
    training_folder,
)
from tangram_lab.experiments.report.kept import Runs, read_kept, runs_to_keep, write_kept
from tangram_lab.experiments.report.study import Study
from tangram_sim.errors import ConfigError


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
    except (OSError, ValueError, IndexError, TypeError, RecursionError):
        return {}


def _outcome(result: Mapping[str, Any]) -> str:
    shown = {
        "mean_reward": "mean reward {:.3f}",
        "coverage": "coverage {:.3f}",
        "angle_error_deg_median": "angle error {:.2f} deg",
    }
    found = [text.format(result[key]) for key, text in shown.items() if result.get(key) is not None]
    seconds = result.get("train_s")
    if found and seconds is not None:
        found.append(f"{duration(seconds)} of training")
    return ", ".join(found) or "done, without scores"


# The runner


LOOK_S = 0.5
# A training that is asked to end writes its checkpoint first.
STOP_S = 60.0
FAILED_STATUS = 1
INTERRUPT_STATUS = 130


def run_study(
    config: StudyConfig,
    resolved: Mapping[str, Mapping[str, Any]],
    asked: Mapping[str, Mapping[str, Any]],
    presets: str | None,
) -> int:
    """Do everything that is missing.

    Args:
        config: the study.
        resolved: the whole config of each training that is wanted.
        asked: the settings of each test of them.
        presets: the folder of the user's own presets, None where there is none.

    Returns:
        Exit status: 0 when all is done, 1 when a job failed, 130 after a signal.

    Raises:
        ConfigError: the folder holds trainings with other settings or budget, or of code that
            trained otherwise, or is in use.
    """
    study, jobs = RunFolder(config.run_dir), make_jobs(config, resolved, asked, presets)
    if not next(path for path in (study.path, *study.path.parents) if path.exists()).is_dir():
        raise ConfigError(
            f"run_dir {study.path} cannot be made (a file is in its way): choose another run_dir"
        )
    for job in jobs:
        job.check()
    content = plan_content(config, _source(), resolved)
    earlier = None if config.keep is None else read_kept(Path(config.keep), content["budget"])
    console = sturdy_console(sys.stdout)
    if config.dry:
        plan = joined_plan(study.path / PLAN, content)
        kept = {} if earlier is None else _kept(plan, earlier, jobs, resolved, study.path, console)
        missing = [job for job in jobs if not job.done and job.run_dir not in kept]
        for job in missing:
            console.print(job.name, highlight=False, soft_wrap=True)
        told = f"{len(missing)} of {len(jobs)} jobs to do in {study.path}"
        console.print(told, highlight=False, soft_wrap=True)
        return 0
    study.prepare("auto")
    with study.lock():
        plan = joined_plan(study.path / PLAN, content)
        kept = _kept(plan, earlier, jobs, resolved, study.path, console)
        write_whole(study.path / PLAN, _json(plan))
        write_kept(kept, jobs)
        missing = [job for job in jobs if not job.done]
        with StudyProgress(console, len(jobs), len(jobs) - len(missing)) as progress:
            return Runner(missing, config.jobs, progress).run()


def _kept(
    plan: dict[str, Any],
    earlier: Study | None,
    jobs: Sequence[Job],
    resolved: Mapping[str, Mapping[str, Any]],
    study: Path,
    console: Console,
) -> Runs:
    """The runs of an earlier report that are kept; the plan gets the fingerprints of this code.

    Raises:
        ConfigError: runs that are there are of code that trained otherwise.
    """
    wanted = (job.training for job in jobs if job.trains and (earlier is not None or not job.done))
    configs = {name: resolved[name] for name in wanted}
    if configs:
        told = f"a fingerprint of this code first: {UPDATES} updates of each of {len(configs)}"
        console.print(f"{told} trainings", highlight=False)
    plan["fingerprints"] |= _fingerprints(plan["fingerprints"], configs, study)
    if earlier is None:
        return {}
    kept = runs_to_keep(earlier, plan, jobs, study)
    console.print(f"{len(kept)} runs are kept of the earlier report", highlight=False)
    return kept


def _fingerprints(
    before: Mapping[str, Fingerprint], configs: Mapping[str, Mapping[str, Any]], study: Path
) -> dict[str, Fingerprint]:
    """Training -> the fingerprint of this code.

    Raises:
        ConfigError: runs that are there are of code that trained otherwise.
    """
    found = make_fingerprints(configs)
    there = {name: training_folder(study, name) for name in before.keys() & found}
    others = {
        there[name]: differences(before[name], found[name])
        for name in sorted(there)
        if there[name].exists()
    }
    changed = [folder for folder, numbers in others.items() if numbers]
    if changed:
        raise ConfigError(
            f"{changed[0]} is of code that trained otherwise: after {UPDATES} updates "
            f"{others[changed[0]][0]}: remove {', '.join(map(str, changed))}, or choose another "
            "run_dir"
        )
    return found


def _source() -> dict[str, object]:
    """Where the numbers of a study come from."""
    return {
        "command": shlex.join(["tangram-experiment", *sys.argv[1:]]),
        "commit": commit(),
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "versions": versions(),
    }


class Runner:
    """Starts jobs as places become free."""

    def __init__(self, jobs: Sequence[Job], at_once: int, progress: StudyProgress) -> None:
        self._waiting, self._at_once, self._progress = deque(jobs), at_once, progress
        self._running: dict[Child, Job] = {}
        self._events: SimpleQueue[Child | signal.Signals] = SimpleQueue()
        self._failed: list[Job] = []
        self._stop_s: float | None = None

    def run(self) -> int:
        """Until nothing is left to do; returns the exit status."""
        with handling(self._events.put):
            try:
                self._work()
            finally:
                self._signal(signal.SIGTERM)  # nobody is left, unless this failed
        if self._stop_s is not None:
            self._progress.say("stopped: give the same command again to go on")
            return INTERRUPT_STATUS
        for job in self._waiting:
            self._progress.say(f"{job.name}: not done, what it needs is missing")
        for job in self._failed:
            self._progress.say(f"{job.name}: failed, see {job.log}")
        return FAILED_STATUS if self._failed or self._waiting else 0

    def _work(self) -> None:
        while self._start_ready() or self._running:
            self._take(self._next())
            self._progress.look(list(self._running.values()))
            if self._stop_s is not None and time.monotonic() >= self._stop_s:
                self._signal(signal.SIGKILL)

    def _start_ready(self) -> bool:
        """Start what there is room for; whether anything was started."""
        started = False
        for job in list(self._waiting):
            if self._stop_s is not None or len(self._running) >= self._at_once:
                break
            if job.ready:
                self._waiting.remove(job)
                self._start(job)
                started = True
        return started

    def _start(self, job: Job) -> None:
        job.prepare()
        child = Child(job.name, job.arguments, job.log)
        child.start(self._events.put)
        self._running[child] = job
        self._progress.started(job)

    def _next(self) -> "Child | signal.Signals | None":
        try:
            return self._events.get(timeout=LOOK_S)
        except Empty:
            return None

    def _take(self, event: "Child | signal.Signals | None") -> None:
        if isinstance(event, signal.Signals):
            # The first wish ends the trainings with a checkpoint, a later one at once.
            self._signal(signal.SIGTERM if self._stop_s is None else signal.SIGKILL)
            self._stop_s = self._stop_s or time.monotonic() + STOP_S
        elif event is not None:
            status, job = event.clear(), self._running.pop(event)
            if job.done:
                self._progress.finished(job, read_object(job.leaves))
            elif self._stop_s is None:
                self._failed.append(job)
                self._progress.say(f"{job.name} ended with {describe(status)}\n{event.tail()}")
            self._progress.ended(job)

    def _signal(self, number: signal.Signals) -> None:
        for child in self._running:
            child.signal(number)


def _json(content: dict[str, object]) -> bytes:
    return (json.dumps(content, indent=1) + "\n").encode()
