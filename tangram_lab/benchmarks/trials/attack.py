"""Every attack of the security review, on trainings; what held, and what was seen."""

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

OPEN = ("max_updates=0", "service.bind=127.0.0.1", *OURS)  # until it was attacked enough
NOISE = 0.02  # of the mean reward, between two trainings of so many updates
UPDATES, LAG = 200, 100  # before the attacks begin


def ends_in_order() -> None:
    """From now on SIGTERM ends what this process has started, as Ctrl-C does."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))


@contextmanager
def beside() -> Iterator[ProcessPoolExecutor]:
    """A process for what may be done meanwhile; it is gone after the block."""
    with ProcessPoolExecutor(1, get_context("spawn"), ends_in_order) as pool:
        try:
            yield pool
        finally:
            for process in active_children():
                process.terminate()


def on_a_port() -> str:
    """A setting: the same one after each restart."""
    return f"service.port={free_port()}"


def wait_for_updates(most: int, folder: Path, launcher: "subprocess.Popen[bytes]") -> None:
    """Wait until a training has done so many, or ended."""
    updates = 0.0
    while updates < most and launcher.poll() is None:
        time.sleep(LOOK_S)
        with suppress(TangramError):
            updates = numbers_of(folder)["updates"]


def run_attack(out: Path | None, folder: Path) -> int:
    """Attack one training, harm others, and compare the score with that of an undisturbed one.

    Args:
        out: JSON file.
        folder: for the runs; must not hold any.

    Returns:
        0 if all held and the score is no worse, else 1.
    """
    begun = time.monotonic()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    live, straight = folder / "live", folder / "straight"
    with beside() as pool, ExitStack() as others:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(OPEN_FILES, hard), hard))
        with training(live, *OPEN, on_a_port(), "service.log_format=json", OFTEN) as target:
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            target.goes_on(UPDATES, "updates")
            until(lambda: target.numbers()["lag_updates"] < LAG)  # from what it began with
            rows = list(tried(BESIEGED, target))
            meanwhile = pool.submit(harmed, folder)
            undisturbed = others.enter_context(started(straight, "max_updates=0", *OURS))
            rows += tried(LIVE, target)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        result = result_of(live)
        with training(folder / "shared", *OPEN, on_a_port()) as target:
            rows += tried(NEIGHBOURS, target)  # nobody asks for its score: they send what they like
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
