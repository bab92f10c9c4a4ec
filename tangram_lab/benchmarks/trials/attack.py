"""Runs all known attacks on real trainings, and reports the outcome."""

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import active_children, get_context
from pathlib import Path

from tangram_core.errors import TangramError
from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.trainings import LOOK_S, free_port, numbers_of, result_of
from tangram_lab.benchmarks.trials.attacks import BESIEGED, LIVE, OPEN_FILES
from tangram_lab.benchmarks.trials.chaos import WORKERS
from tangram_lab.benchmarks.trials.harms import harmed
from tangram_lab.benchmarks.trials.neighbours import NEIGHBOURS
from tangram_lab.benchmarks.trials.target import (
    OFTEN,
    OURS,
    started,
    training,
    tried,
    until,
)

OPEN = ("max_updates=0", "service.bind=127.0.0.1", *OURS)  # without end, on a port
NOISE = 0.02  # of the mean reward, between two undisturbed trainings of this length
UPDATES, LAG = 200, 100  # attacks begin after so many updates, when the learner lags by less


def ends_in_order() -> None:
    """Make SIGTERM end this process and its children in order, as Ctrl-C does."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))


@contextmanager
def beside() -> Iterator[ProcessPoolExecutor]:
    """A pool of one process for parallel work; all child processes end with this context."""
    with ProcessPoolExecutor(1, get_context("spawn"), ends_in_order) as pool:
        try:
            yield pool
        finally:
            for process in active_children():
                process.terminate()


def on_a_port() -> str:
    """A setting for a free port, which the master keeps after each restart."""
    return f"service.port={free_port()}"


def wait_for_updates(most: int, folder: Path, launcher: "subprocess.Popen[bytes]") -> None:
    """Wait until a training has done `most` updates, or has ended."""
    updates = 0.0
    while updates < most and launcher.poll() is None:
        time.sleep(LOOK_S)
        with suppress(TangramError):
            updates = numbers_of(folder)["updates"]


def run_attack(out: Path | None, folder: Path) -> int:
    """Run all attacks, and compare the score of the attacked training with an undisturbed one.

    Args:
        out: JSON file for the results; None writes none.
        folder: folder for the runs, without any runs yet.

    Returns:
        0 if no attack did harm and the score is no worse, else 1.
    """
    begun = time.monotonic()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    live, straight = folder / "live", folder / "straight"
    with beside() as pool, ExitStack() as others:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(OPEN_FILES, hard), hard))
        with training(live, *OPEN, on_a_port(), "service.log_format=json", OFTEN) as target:
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            target.goes_on(UPDATES, "updates")
            until(lambda: target.numbers()["lag_updates"] < LAG)  # the lag of the start is gone
            rows = list(tried(BESIEGED, target))
            meanwhile = pool.submit(harmed, folder)
            undisturbed = others.enter_context(started(straight, "max_updates=0", *OURS))
            rows += tried(LIVE, target)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        result = result_of(live)
        with training(folder / "shared", *OPEN, on_a_port()) as target:
            # The run's own workers take their indices from any other key.
            until(lambda: target.numbers()["players"] >= WORKERS)
            rows += tried(NEIGHBOURS, target)  # forged episodes here cannot spoil the score
        rows += meanwhile.result()
        wait_for_updates(result["updates"], straight, undisturbed)
    other = result_of(straight)
    scores = {"attacked": result["mean_reward"], "undisturbed": other["mean_reward"]}
    no_worse = scores["attacked"] >= scores["undisturbed"] - NOISE
    rows.append(
        {
            "attack": "the score of the training",
            "tried": f"{result['updates']:,} updates",
            "held": no_worse,
            "seen": f"{scores['attacked']:.4f}, undisturbed {scores['undisturbed']:.4f} "
            f"after {other['updates']:,}",
        }
    )
    show("attacks", [row | {"held": "yes" if row["held"] else "NO"} for row in rows])
    held, took = sum(row["held"] for row in rows), time.monotonic() - begun
    print(f"tried {len(rows)}, held {held}, in {took:.0f} s")
    write(out, {"rows": rows, "tried": len(rows), "held": held, "seconds": took, **scores})
    return int(held < len(rows))
