"""More workers: real ones in miniature trainings, and up to 1,000 synthetic ones of one master.

Two runs that are compared are alive at one time; while one is measured, the processes of the other
are stopped. So what else the machine does meets both.
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
from tangram_lab.benchmarks.measure import Bound, Row, compared, single
from tangram_lab.benchmarks.setups import played, preset
from tangram_lab.benchmarks.speed.players import players
from tangram_lab.benchmarks.trainings import numbers_of, processes_of, start_training, wait_for

STAGE = "scaling"
CORES = 8  # below which two workers share cores with the rest
LINEAR = Bound(least=0.9)
SAME = Bound(least=0.9)
SYNTHETIC = 64, 1000
BATCH = 32
PUBLISH_S = 0.5
SETTLE_S = 2.0  # a broadcast at least: one is due where a stopped run goes on
SPAN_S = 6.0  # longer than it takes to the next one
PATIENCE_S = 120.0
ENDLESS = ("max_updates=0", "service.checkpoint_minutes=60", "service.http_port=-1")
# Play is slow, learning is next to nothing, and the evaluator rests.
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
    """A run that is stopped unless it is measured.

    Attributes:
        folder: of the run.
        more: processes beside those that name the folder.
    """

    folder: Path
    more: list[int] = field(default_factory=list)

    def signal(self, number: signal.Signals) -> None:
        """To all processes of the run."""
        pids = (process.pid for process in processes_of(self.folder))
        for pid in (*pids, *self.more):
            os.kill(pid, number)

    @contextmanager
    def awake(self) -> Iterator[None]:
        """Let the stopped processes run while inside."""
        self.signal(signal.SIGCONT)
        try:
            yield
        finally:
            self.signal(signal.SIGSTOP)

    def numbers(self) -> dict[str, float]:
        """The status of the master; it is a second old at most."""
        return numbers_of(self.folder, PATIENCE_S)

    def cpu_s(self) -> float:
        """CPU time of the processes that name the folder."""
        spent = (process.cpu_times() for process in processes_of(self.folder))
        return float(sum(one.user + one.system for one in spent))

    def master_size(self) -> tuple[float, float]:
        """Its resident memory in MiB, and how many descriptors it has open."""
        (master,) = processes_of(self.folder)
        return master.memory_info().rss / 2**20, float(master.num_fds())

    def rates(self, *names: str) -> dict[str, float]:
        """By how much some numbers grow in a second, and CPU seconds as "cpu"."""
        with self.awake():
            # Who was stopped for long is let in anew.
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
        """Wait until its numbers say so."""
        until = time.monotonic() + PATIENCE_S
        while not ready(self.numbers()):
            if time.monotonic() > until:
                raise TangramError(f"the run in {self.folder} does not get under way")
            time.sleep(0.5)


def measure_scaling(runs: int) -> list[Row]:
    """Real workers, and synthetic ones."""
    with tempfile.TemporaryDirectory(prefix="tangram-") as folder:
        real = list(_real(runs, Path(folder)))
        fed = [row for count in SYNTHETIC for row in _synthetic(runs, Path(folder), count)]
        return [*real, *fed]


def _real(runs: int, folder: Path) -> Iterator[Row]:
    """Episodes/s of two workers against one."""
    with ExitStack() as stack:
        alone, both = (
            stack.enter_context(_training(folder / f"workers_{n}", n, f"workers={n}", *PLAYING))
            for n in (1, 2)
        )
        found = [[run.rates("episodes")["episodes"] for run in (both, alone)] for _ in range(runs)]
    two, one = zip(*found, strict=True)
    yield compared((STAGE, "2 workers, a finger", "episodes/s"), two, "1 worker", one)
    shares = [ours / theirs / 2.0 for ours, theirs in found]
    bound = LINEAR if len(os.sched_getaffinity(0)) >= CORES else None
    yield single((STAGE, "2 workers, efficiency", "of twice 1 worker"), shares, bound)


def _synthetic(runs: int, folder: Path, count: int) -> Iterator[Row]:
    """A master that learns, with so many players and with one."""
    names = ("updates", "hub/batches", "hub/published")
    with ExitStack() as stack:
        one, many = (
            stack.enter_context(_fed(folder / f"{n}_beside_{count}", n)) for n in (1, count)
        )
        found = [(many.rates(*names), one.rates(*names)) for _ in range(runs)]
        sizes = [run.master_size() for run in (many, one)]
    case, against = f"{count:,} synthetic workers", "1 synthetic worker"
    for name, unit, bound in (
        ("updates", "updates/s", SAME),
        ("hub/batches", "messages/s", None),
        ("hub/published", "broadcasts/s", None),
    ):
        ours, theirs = [m[name] for m, _ in found], [o[name] for _, o in found]
        yield compared((STAGE, case, unit), ours, against, theirs, bound)
    # What the rest of a busy machine takes from one run more than from the other is left out.
    ours, theirs = (
        [run["updates"] / run["cpu"] for run in both] for both in zip(*found, strict=True)
    )
    yield compared((STAGE, case, "updates per CPU second"), ours, against, theirs)
    for unit, ours, theirs in zip(("MiB", "descriptors"), *sizes, strict=True):
        yield compared((STAGE, f"{case}, the master's", unit), [ours], against, [theirs])


@contextmanager
def _training(folder: Path, count: int, *settings: str, name: str = "train") -> Iterator[Run]:
    """A training or a master with so many players, stopped once all of them have played."""
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
    """A master of its own with so many synthetic players."""
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
