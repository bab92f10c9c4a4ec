"""Do the missing jobs of a study: train, test with tangram-eval, and add rows to its CSV file."""

import json
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from rich.console import Console

from master.children import Child, describe
from master.record.rundir import RunFolder
from master.signals import SIGNALS
from tangram_core.errors import ConfigError
from tangram_core.run.code import override
from tangram_core.run.process import handling
from tangram_core.scores import decimal
from tangram_core.store.files import write_whole
from tangram_lab.experiments.rows import (
    COLUMNS,
    CURVE,
    OLD,
    append,
    curve_rows,
    done,
    rows_of,
    tell_of_old,
)
from tangram_lab.experiments.studies import Job, StudyConfig

TOLD = "told.json"
LOOK_S = 0.5
STOP_S = 60.0  # time for a stopped training to write its checkpoint
FAILED_STATUS, INTERRUPT_STATUS = 1, 130
BUDGET = ("max_updates", "max_episodes", "max_hours")  # `ended_by` of a finished training


class Work:
    """One job: a training with one seed, then its tests, one process after the other.

    Args:
        job: the training and its tests.
        run_dir: folder of this run.
        missing: names of the tests without a row.
        first: the work whose agent is trained further; None to begin anew.
    """

    def __init__(
        self, job: Job, run_dir: Path, missing: Sequence[str], first: "Work | None"
    ) -> None:
        self.job, self.run_dir, self.missing, self.first = job, run_dir, list(missing), first

    @property
    def trained(self) -> bool:
        """Whether the training has used its whole budget."""
        return str(read_json(self.run_dir / "result.json").get("ended_by")).startswith(BUDGET)

    @property
    def ready(self) -> bool:
        """Whether the work may begin: the training before it, if any, is finished."""
        return self.first is None or self.first.trained or self.trained

    def scores(self, test: str) -> Path:
        """Path of the file with the scores of a test."""
        return self.run_dir / "tests" / f"{test}.json"

    def check(self) -> None:
        """Raise ConfigError if the run in this folder was begun with other settings."""
        told = read_json(self.run_dir / TOLD).get("told", list(self.job.told))
        if told != list(self.job.told):
            raise ConfigError(
                f"{self.run_dir} was begun with other settings ({' '.join(told)}, now "
                f"{' '.join(self.job.told)}): remove this folder, or choose another run_dir"
            )

    def next(self) -> Child | None:
        """The next process to start; None if all are done."""
        if not self.trained:
            told = ["train", override("run_dir", str(self.run_dir)), f"seed={self.job.seed}"]
            if self.first:
                told.append(override("warm_start", str(self.first.run_dir)))
            return self._child([*told, "resume=auto", *self.job.told], "training.log")
        for test in self.missing:
            if not self.scores(test).exists():
                self.scores(test).parent.mkdir(exist_ok=True)
                told = ["eval", override("run_dir", str(self.run_dir))]
                told += [override("out", str(self.scores(test))), *self.job.tests[test]]
                return self._child(told, "tests.log")
        return None

    def _child(self, told: list[str], log: str) -> Child:
        write_whole(self.run_dir / TOLD, json.dumps({"told": self.job.told}).encode())
        return Child(self.job.name, told, self.run_dir / log)

    def write(self, folder: Path, study: str) -> str:
        """Append the rows of all tests, and the curve if a figure needs it; return a summary."""
        job, result = self.job, read_json(self.run_dir / "result.json")
        lines = (self.run_dir / "curve.jsonl").read_text(encoding="utf-8").splitlines()
        curve = [json.loads(line) for line in lines]
        rows: list[dict[str, Any]] = []
        for test in self.missing:
            scores = read_json(self.scores(test))
            rows += rows_of(job.training, job.label, job.seed, test, result, scores, curve)
        if job.drawn and self.missing:
            points = curve_rows(job.training, job.seed, curve)
            append(folder / f"{study}_curves.csv", CURVE, points)
        append(folder / f"{study}.csv", COLUMNS, rows)
        reward = result.get("mean_reward")
        return "done" if reward is None else f"mean reward {decimal(reward)}"


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file; empty if the file is missing or cannot be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(content, dict):
        return {}
    for name in tell_of_old(content, path):
        content.setdefault(OLD[name], content.pop(name))
    return content


def run_study(config: StudyConfig, jobs: Sequence[Job], console: Console) -> int:
    """Run all jobs that have no rows yet.

    Returns:
        Exit status: 0 if all are done, 1 if a job failed, 130 after a signal.

    Raises:
        ConfigError: the folder is in use or cannot be made, or has a run with other settings.
    """
    root, out = Path(config.run_dir), Path(config.out or config.run_dir)
    there = done(out / f"{config.study}.csv")
    works: dict[tuple[str, int], Work] = {}
    for job in jobs:
        missing = [test for test in job.tests if (job.training, job.seed, test) not in there]
        run_dir = root / config.study / job.training / f"seed_{job.seed}"
        first = works[job.after, job.seed] if job.after else None
        works[job.training, job.seed] = Work(job, run_dir, missing, first)
    wanted = list[Work]()
    for work in reversed(works.values()):  # reversed: a training comes after its `first`
        if work.missing or any(then.first is work and not then.trained for then in wanted):
            work.check()
            wanted.insert(0, work)
    console.print(f"{len(jobs) - len(wanted)} of {len(jobs)} runs are in {config.study}.csv")
    folder = RunFolder(root)
    folder.prepare("auto")
    with folder.lock():
        return Runner(wanted, config, out, console).run()


class Runner:
    """Does up to `config.jobs` pieces of work at a time, until all are done or a signal arrives."""

    def __init__(
        self, wanted: Sequence[Work], config: StudyConfig, out: Path, console: Console
    ) -> None:
        self._waiting, self._config, self._out = list(wanted), config, out
        self._count, self._console = len(wanted), console
        self._running: dict[Child, Work] = {}
        self._events: SimpleQueue[Child | signal.Signals] = SimpleQueue()
        self._ready, self._failed = 0, list[Work]()
        self._stop_s: float | None = None

    def run(self) -> int:
        """Do all the work; return the exit status as in `run_study`."""
        with handling(self._events.put, SIGNALS):
            try:
                self._work()
            finally:
                self._signal(signal.SIGTERM)  # children are left only after an exception
        if self._stop_s is not None:
            self._console.print("stopped: repeat the same command to continue")
            return INTERRUPT_STATUS
        return FAILED_STATUS if self._failed else 0

    def _work(self) -> None:
        while True:
            while self._stop_s is None and len(self._running) < self._config.jobs:
                work = next((work for work in self._waiting if work.ready), None)
                if work is None:
                    break
                self._waiting.remove(work)
                self._go_on(work)
            if not self._running:
                for work in self._waiting if self._stop_s is None else ():
                    self._failed.append(work)
                    self._tell(work, "not begun, because the training before it failed")
                return
            try:
                self._take(self._events.get(timeout=LOOK_S))
            except Empty:
                if self._stop_s is not None and time.monotonic() >= self._stop_s:
                    self._signal(signal.SIGKILL)

    def _go_on(self, work: Work) -> None:
        child = work.next()
        if child is None:
            told = work.write(self._out, self._config.study)
            self._ready += 1
            self._tell(work, told)
        else:
            child.start(self._events.put)
            self._running[child] = work

    def _take(self, event: Child | signal.Signals) -> None:
        if isinstance(event, signal.Signals):
            # The first signal ends the trainings with a checkpoint, a second one at once.
            self._signal(signal.SIGTERM if self._stop_s is None else signal.SIGKILL)
            self._stop_s = self._stop_s or time.monotonic() + STOP_S
            return
        status, work = event.clear(), self._running.pop(event)
        if self._stop_s is not None:
            return
        if status:
            self._failed.append(work)
            self._tell(work, f"ended with {describe(status)}, see {event.log}\n{event.tail()}")
        else:
            self._go_on(work)

    def _tell(self, work: Work, text: str) -> None:
        line = f"[{self._ready + len(self._failed)}/{self._count}] {work.job.name}: {text}"
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _signal(self, number: signal.Signals) -> None:
        for child in self._running:
            child.signal(number)
