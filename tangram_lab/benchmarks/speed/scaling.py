"""Scaling with workers: real ones in small trainings, and up to 1,000 synthetic ones.

The two runs of a comparison exist at the same time. While one is measured, the processes of the
other are stopped, so other load on the machine affects both alike.
"""

import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tangram_core.errors import TangramError
from tangram_lab.benchmarks.measure import Row, row_of
from tangram_lab.benchmarks.setups import played, preset
from tangram_lab.benchmarks.speed.players import players
from tangram_lab.benchmarks.trainings import numbers_of, processes_of, start_training, wait_for

STAGE = "scaling"
CORES = 8  # with fewer, two workers share cores with other processes
LEAST = 0.9  # of linear scaling, and of the rates with one synthetic worker
SYNTHETIC = 64, 1000
BATCH = 32
PUBLISH_S = 0.5
SETTLE_S = 2.0  # lets the broadcast pass that is due when a stopped run continues
SPAN_S = 6.0  # longer than the interval between two broadcasts
PATIENCE_S = 120.0
ENDLESS = ("max_updates=0", "service.checkpoint_minutes=60", "service.http_port=-1")
# Play is the slow part, learning takes almost no time, and the evaluator rests.
PLAYING = (
    *ENDLESS,
    "task=push",
    "tokens=tangram7",
    "task.count=2",
    "agent.updates_per_transition=0.001",
    "service.eval_seconds=3600",
    "service.eval_episodes=1",
)


@dataclass
class Run:
    """A run whose processes are stopped except during a measurement.

    Attributes:
        folder: run folder.
        more: ids of further processes, whose command lines do not contain the folder.
    """

    folder: Path
    more: list[int] = field(default_factory=list)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to all processes of the run."""
        pids = (process.pid for process in processes_of(self.folder))
        for pid in (*pids, *self.more):
            os.kill(pid, number)

    @contextmanager
    def awake(self) -> Iterator[None]:
        """Let the stopped processes run inside this context."""
        self.signal(signal.SIGCONT)
        try:
            yield
        finally:
            self.signal(signal.SIGSTOP)

    def numbers(self) -> dict[str, float]:
        """Name -> number in the status of the master, at most a second old."""
        return numbers_of(self.folder, PATIENCE_S)

    def cpu_s(self) -> float:
        """CPU seconds of the processes whose command lines contain the folder."""
        spent = (process.cpu_times() for process in processes_of(self.folder))
        return float(sum(one.user + one.system for one in spent))

    def master_size(self) -> tuple[float, float]:
        """Resident memory of the master in MiB, and its number of open file descriptors."""
        (master,) = processes_of(self.folder)
        return master.memory_info().rss / 2**20, float(master.num_fds())

    def rates(self, *names: str) -> dict[str, float]:
        """Growth per second of these numbers of the status, and of CPU seconds as "cpu"."""
        with self.awake():
            # Workers that were stopped for long must join again first.
            episodes = self.numbers()["episodes"]
            self.wait(lambda now: now["episodes"] > episodes)
            time.sleep(SETTLE_S)
            begin, spent, before = time.monotonic(), self.cpu_s(), self.numbers()
            time.sleep(SPAN_S)
            after = self.numbers()
            end, spent = time.monotonic(), self.cpu_s() - spent
        passed = after["elapsed_s"] - before["elapsed_s"]
        grown = {name: (after[name] - before[name]) / passed for name in names}
        return {**grown, "cpu": spent / (end - begin)}

    def wait(self, ready: Callable[[dict[str, float]], bool]) -> None:
        """Wait until `ready` is true for the numbers of the status; TangramError if too late."""
        until = time.monotonic() + PATIENCE_S
        while not ready(self.numbers()):
            if time.monotonic() > until:
                told = (self.folder / "told").read_text(errors="replace")[-1000:]
                raise TangramError(
                    f"the run makes no progress for {PATIENCE_S:g} s; it told: {told}"
                )
            time.sleep(0.5)


def measure_scaling(runs: int) -> list[Row]:
    """Measure real workers, and synthetic ones; rows of the table."""
    with tempfile.TemporaryDirectory(prefix="tangram-") as folder:
        real = list(_real(runs, Path(folder)))
        fed = [row for count in SYNTHETIC for row in _synthetic(runs, Path(folder), count)]
        return [*real, *fed]


def _real(runs: int, folder: Path) -> Iterator[Row]:
    """Episodes per second of two workers, compared with one."""
    with ExitStack() as stack:
        alone, both = (
            stack.enter_context(_training(folder / f"workers_{n}", n, f"workers={n}", *PLAYING))
            for n in (1, 2)
        )
        found = [[run.rates("episodes")["episodes"] for run in (both, alone)] for _ in range(runs)]
    two, one = zip(*found, strict=True)
    yield row_of((STAGE, "2 workers, a finger", "episodes/s"), two, "1 worker", one)
    shares = [ours / theirs / 2.0 for ours, theirs in found]
    least = LEAST if len(os.sched_getaffinity(0)) >= CORES else None
    yield row_of((STAGE, "2 workers, efficiency", "of twice 1 worker"), shares, least=least)


def _synthetic(runs: int, folder: Path, count: int) -> Iterator[Row]:
    """Rates and size of a learning master with `count` players, compared with one player."""
    names = ("updates", "hub/batches", "hub/published")
    with ExitStack() as stack:
        one, many = (
            stack.enter_context(_fed(folder / f"{n}_beside_{count}", n)) for n in (1, count)
        )
        found = [(many.rates(*names), one.rates(*names)) for _ in range(runs)]
        sizes = [run.master_size() for run in (many, one)]
    case, against = f"{count:,} synthetic workers", "1 synthetic worker"
    for name, unit, least in (
        ("updates", "updates/s", LEAST),
        ("hub/batches", "messages/s", None),
        ("hub/published", "broadcasts/s", None),
    ):
        ours, theirs = [m[name] for m, _ in found], [o[name] for _, o in found]
        yield row_of((STAGE, case, unit), ours, against, theirs, least)
    # Per CPU second, so that load of other programs during one of the runs does not count.
    ours, theirs = (
        [run["updates"] / run["cpu"] for run in both] for both in zip(*found, strict=True)
    )
    yield row_of((STAGE, case, "updates per CPU second"), ours, against, theirs)
    for unit, ours, theirs in zip(("MiB", "descriptors"), *sizes, strict=True):
        yield row_of((STAGE, f"{case}, the master's", unit), [ours], against, [theirs])


@contextmanager
def _training(folder: Path, count: int, *settings: str, name: str = "train") -> Iterator[Run]:
    """Run a training or a master; a training is stopped once all `count` players have joined."""
    process = start_training(folder, *settings, name=name)
    run = Run(folder)
    try:
        wait_for(folder / "connection.json", process)
        if name == "train":
            _settle(run, count)
        yield run
    finally:
        run.signal(signal.SIGCONT)
        process.terminate()
        process.wait()


def _settle(run: Run, count: int) -> None:
    run.wait(lambda now: now["players"] == count and now["updates"] > 0)
    run.signal(signal.SIGSTOP)


@contextmanager
def _fed(folder: Path, count: int) -> Iterator[Run]:
    """Run a master with `count` synthetic players."""
    setup = preset()
    settings = (*ENDLESS, f"service.publish_seconds={PUBLISH_S}")
    connect = folder / "connection.json"
    with (
        _training(folder, count, *settings, name="master") as run,
        players(connect, setup, played(setup, BATCH), count) as pid,
    ):
        run.more.append(pid)
        _settle(run, count)
        try:
            yield run
        finally:
            run.signal(signal.SIGCONT)
            run.more.clear()
