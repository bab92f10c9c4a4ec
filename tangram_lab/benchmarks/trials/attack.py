"""Every attack of the security review, on files and trainings; what held, and what was seen."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from master.record.delivery import EpisodesArrived
from master.record.journal import MAGIC, Journal, segments
from master.record.recovery import Reader
from tangram_core.errors import RunError, TangramError
from tangram_core.setup import Setup, make_setup
from tangram_core.store.checkpoints import list_checkpoints, load_checkpoint, save_checkpoint
from tangram_core.wire.messages import EpisodeBatch
from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.trainings import LOOK_S, MIB, numbers_of, result_of
from tangram_lab.benchmarks.trials.attacks import BESIEGED, LIVE, OPEN_FILES
from tangram_lab.benchmarks.trials.harms import harmed
from tangram_lab.benchmarks.trials.target import (
    OFTEN,
    OURS,
    Attack,
    Seen,
    episodes_of,
    one_line,
    started,
    training,
    tried,
)
from tangram_sim.puzzles.figures import parse_puzzles, parse_svg_puzzle

ON_A_PORT = ("service.bind=127.0.0.1", "service.log_format=json")
NOISE = 0.02  # of the mean reward, between two trainings of so many updates
UPDATES = 200  # before the attacks begin
BATCHES = 40
TASK: dict[str, Any] = {
    "task": {"kind": "place"},
    "tokens": {"shapes": ["square"], "scale": 1.0},
    "agent": {"kind": "pair"},
    **{name: {} for name in ("sim", "reward", "net")},
}


# Files


def forged_settings(folder: Path) -> Seen:
    (folder / "own.py").write_text("open('loaded', 'w')\ndef near(a, d, l): return [0.0] * len(a)")
    settings = TASK | {"service": {}, "reward": {"name": "own.py:near"}}
    content = {"endpoint": "tcp://127.0.0.1:1", "run_id": "x", "settings": settings}
    (folder / "connection.json").write_text(json.dumps(content))
    held, seen = one_line("worker", "connect=connection.json", cwd=folder)
    return held and not (folder / "loaded").exists(), seen


def nested_files(folder: Path) -> Seen:
    deep, run = "[" * 100_000, folder / "nested"
    (run / "checkpoints/00000010").mkdir(parents=True)
    (run / "checkpoints/00000010/manifest.json").write_text(deep)
    (run / "config.yaml").write_text(json.dumps(TASK))
    (run / "connection.json").write_text(deep)
    (folder / "deep.yaml").write_text(deep)
    lines: list[tuple[str, ...]] = [("eval", f"run_dir={run}"), ("worker", f"connect={run}")]
    lines += [("train", "from_config=deep.yaml"), ("eval", "run_dir=x", "puzzle=deep.yaml")]
    seen = [one_line(*line, cwd=folder) for line in lines]
    held = sum(one for one, _ in seen)
    return held == len(seen), f"{held} of {len(seen)} in one line"


def bombs(_folder: Path) -> Seen:
    many, triangle = 100_000, '<polygon points="0,0 1,0 0,1"/>'
    groups = f"<svg>{'<g>' * many}{'</g>' * many}</svg>"
    laughs = '<!DOCTYPE svg [<!ENTITY a "b"><!ENTITY c "&a;&a;">]><svg>&c;</svg>'
    drawings = [groups, laughs, f"<svg>{'<g/>' * 9 * many}</svg>", f"<svg>{triangle * many}</svg>"]
    drawings += [f'<svg><path d="{"M 0 0 L 1 1 " * many}"/></svg>', f"<svg>{' ' * 5 * MIB}</svg>"]
    drawings += [f'<svg><g transform="{"scale(1e300)" * 50}">{triangle}</g></svg>', "<svg" * many]
    texts = ["[" * many, '{"a":' * many, "1" * many, f'"{"x" * 5 * MIB}"', "[1e999]", "NaN", "[]"]
    texts += [json.dumps({"format": "x", "puzzles": [[]] * many}), f"[{'0,' * many}0]"]
    refused, slowest = 0, 0.0
    both: Iterable[tuple[str, Callable[[str, str], object]]] = [
        *((text, parse_svg_puzzle) for text in drawings),
        *((text, parse_puzzles) for text in texts),
    ]
    for text, parse in both:
        begun = time.process_time()
        with suppress(TangramError):
            parse(text, "it")
            refused -= 1
        refused, slowest = refused + 1, max(slowest, time.process_time() - begun)
    held = refused == len(drawings + texts) and slowest < 2.0
    return held, f"{refused} of {len(drawings + texts)} refused, the slowest in {slowest:.2f} s"


def written_journal(folder: Path, setup: Setup) -> tuple[Path, Callable[[], tuple[int, list[str]]]]:
    """A journal of three segments, and how many of its batches are read, with the losses told."""
    path, spec, digest = folder / "journal", setup.spec, setup.task_digest()
    shutil.rmtree(path, ignore_errors=True)
    with closing(Journal(path, "run", digest, 0.0)) as journal:
        for number in range(1, BATCHES + 1):
            batch = EpisodeBatch(number, 0, episodes_of(setup, 2))
            journal.append(EpisodesArrived("player", 0, 1, batch, batch.encode(spec)))
            if number % (BATCHES // 3) == 0:
                journal.rotate()

    def read() -> tuple[int, list[str]]:
        told: list[str] = []
        return sum(1 for _ in Reader(path, None, "run", digest, spec, told.append)), told

    return path, read


def damaged_journal(folder: Path) -> Seen:
    setup, seen, held = make_setup(TASK), [], True
    for kind in ("a bit", "garbage", "missing"):
        path, read = written_journal(folder, setup)
        middle = sorted(segments(path).values())[1]
        data = bytearray(middle.read_bytes())
        inside, most = data.count(MAGIC) - 1, BATCHES
        if kind == "a bit":
            data[data.find(MAGIC, len(data) // 2) + len(MAGIC)] ^= 1
            middle.write_bytes(data)
            most = 1
        elif kind == "garbage":
            middle.write_bytes(np.random.default_rng(0).bytes(len(data)))
        else:
            middle.unlink()
        found, told = read()
        lost = BATCHES - found
        numbered = any(f"{lost} batch" in line for line in told)
        held = held and lost <= min(most, inside) and numbered
        seen.append(f"{kind}: {lost} lost, {'told' if numbered else 'not told'}")
    return held, "; ".join(seen)


def damaged_checkpoints(folder: Path) -> Seen:
    path, refused = folder / "checkpoints", 0
    for harm in (b"bit", b"cut", b"path"):
        shutil.rmtree(path, ignore_errors=True)
        save_checkpoint(path, 1, {"weights": {"w": np.zeros(1000, np.float32)}}, {}, 2)
        [made] = list_checkpoints(path)
        file = made / ("manifest.json" if harm == b"path" else "weights.safetensors")
        data = bytearray(file.read_bytes())
        if harm == b"bit":
            data[len(data) // 2] ^= 1
        changed = data[:-100] if harm == b"cut" else data.replace(b'"weights"', b'"../../etc"')
        file.write_bytes(changed)
        try:
            load_checkpoint(made)
        except RunError:
            refused += 1
    return refused == 3, f"{refused} of 3 refused"


def synced_parents(folder: Path) -> Seen:
    synced: set[int] = set()
    real = os.fsync

    def note(handle: int) -> None:
        synced.add(os.fstat(handle).st_ino)
        real(handle)

    with mock.patch("os.fsync", note):
        path, _ = written_journal(folder, make_setup(TASK))
        save_checkpoint(folder / "points", 1, {"a": {"w": np.zeros(1, np.float32)}}, {}, 2)
    places = (folder, path, folder / "points", list_checkpoints(folder / "points")[0])
    missing = [place.name for place in places if place.stat().st_ino not in synced]
    return not missing, f"not synced: {', '.join(missing) or 'none'}"


def unwritable(folder: Path) -> Seen:
    return one_line("master", "run_dir=/proc/tangram", cwd=folder)


FILES: list[Attack] = [
    ("7", "a damaged journal", "3 kinds", damaged_journal),
    ("11", "names that are not on the disk", "4 folders", synced_parents),
    ("12", "deeply nested files", "4", nested_files),
    ("13", "code that settings name", "1 connection file", forged_settings),
    ("held", "bombs in SVG and JSON", "17", bombs),
    ("held", "damaged and forged checkpoints", "3", damaged_checkpoints),
    ("held", "a read-only place", "1", unwritable),
]


# All of them


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


def wait_for_updates(most: int, folder: Path, launcher: "subprocess.Popen[bytes]") -> None:
    """Wait until a training has done so many, or ended."""
    updates = 0.0
    while updates < most and launcher.poll() is None:
        time.sleep(LOOK_S)
        with suppress(TangramError):
            updates = numbers_of(folder)["updates"]


def run_attack(out: Path | None, folder: Path) -> int:
    """Attack a training, harm another, and compare the score with that of an undisturbed one.

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
        with training(live, "max_updates=0", *ON_A_PORT, *OURS, OFTEN) as target:
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            rows = list(tried(FILES, folder))
            target.goes_on(UPDATES, "updates")
            rows += tried(BESIEGED, target)
            meanwhile = pool.submit(harmed, folder)
            undisturbed = others.enter_context(started(straight, "max_updates=0", *OURS))
            rows += tried(LIVE, target)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        result = result_of(live)
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
