"""Every attack of the security review, on trainings that run; what held, and what was seen."""

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from threading import Timer
from typing import Any
from unittest import mock

import numpy as np
import psutil

from master.children import command, override
from master.delivery import EpisodesArrived
from master.journal import MAGIC, Journal, segments
from master.recovery import Reader
from tangram_agent.arrays import EpisodeSpec
from tangram_agent.checkpoints import list_checkpoints, load_checkpoint, save_checkpoint
from tangram_agent.messages import EpisodeBatch
from tangram_agent.schema import MAX_COUNT
from tangram_agent.setup import Setup, make_setup
from tangram_lab.benchmarks.attacks import (
    ENDS_S,
    LIVE,
    OPEN_FILES,
    Seen,
    Target,
    episodes_of,
    training,
)
from tangram_lab.benchmarks.chaos import SETTINGS, Witness, compare
from tangram_lab.benchmarks.intruder import NOBODY, knock
from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.trainings import MIB, result_of, start_training
from tangram_sim.errors import RunError, TangramError
from tangram_sim.puzzles import parse_puzzles, parse_svg_puzzle
from worker.client import Client

Attack = tuple[str, str, str, Callable[[Any], Seen]]  # row, what, how much, and what does it
OFTEN = "service.checkpoint_minutes=0.05"
ON_A_PORT = ("service.bind=127.0.0.1", "service.log_format=json")
NOISE = 0.02  # of the mean reward, between two trainings of so many updates
UPDATES = 200  # before the attacks begin
BATCHES = 40
TASK: dict[str, Any] = {"tokens": {"shapes": ["square"], "scale": 1.0}} | {
    name: {} for name in ("sim", "reward", "agent", "net")
}


def one_line(*arguments: str, cwd: Path) -> Seen:
    """Whether a command refuses in one line, with status 2."""
    done = subprocess.run(
        [sys.executable, *command(arguments[0]), *arguments[1:]],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=ENDS_S,
        check=False,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    lines = done.stderr.strip().splitlines()
    return (done.returncode, len(lines)) == (2, 1), f"{len(lines)} lines: {' '.join(lines)[-90:]}"


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
    path, spec, digest = folder / "journal", EpisodeSpec.of(setup), setup.task_digest()
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


# Trainings that are harmed


def sockets_of_others(target: Target) -> Seen:
    place = Path(target.where["endpoint"].removeprefix("ipc://"))
    private = place.is_socket() and not place.parent.stat().st_mode & 0o077
    stranger = knock(target.where["endpoint"], [target.hello(index=0)], NOBODY)
    stranger.join(10.0)
    answers = stranger.exitcode if os.geteuid() == 0 else 0
    return private and answers == 0, f"{place.parent}: private {private}, {answers} answers"


def second_master(target: Target) -> Seen:
    arguments = (override("run_dir", str(target.folder)), "resume=auto", *SETTINGS[1:])
    held, seen = one_line("master", *arguments, cwd=target.folder.parent)
    return held and "in use" in seen and target.goes_on(), seen


def killed(target: Target) -> bool:
    """Whether a training goes on after its master was killed, with batches in the journal alone."""
    target.checkpoint()
    target.goes_on(20.0)
    master = target.master
    master.kill()
    until_s = time.monotonic() + ENDS_S
    while time.monotonic() < until_s:
        with suppress(TangramError, psutil.Error):
            if target.master.pid != master.pid and target.goes_on(10.0):
                return True
        time.sleep(0.2)
    return False


def killed_after_huge_numbers(target: Target) -> Seen:
    """With a batch, so that the numbers would be in journal and checkpoint."""
    setup = target.setup
    batch = EpisodeBatch(1, 0, episodes_of(setup, 1)).encode(EpisodeSpec.of(setup))
    for huge in (2**63 - 1, MAX_COUNT):
        target.ask(target.hello(incarnation=huge), batch)
        target.ask(target.hello(incarnation=1, first=huge, index=3001, process="other"))
    held = killed(target)
    return held, "it goes on" if held else "it does not come back"


def killed_after_unlink(target: Target) -> Seen:
    """Just after a checkpoint, so that it is not the next one that begins another segment."""
    journal = target.folder / "journal"
    target.checkpoint()
    for path in segments(journal).values():
        path.unlink(missing_ok=True)
    target.goes_on(20.0)
    told, held = "has lost its newest segment" in target.told(), killed(target)
    return told and held, f"told: {told}; killed after a checkpoint, it goes on: {held}"


def folder_away(target: Target) -> Seen:
    target.goes_on()
    away = target.folder.with_name("away")
    target.folder.rename(away)
    time.sleep(3.0)
    stopped = not target.folder.exists()
    if stopped:
        away.rename(target.folder)
    held, told = stopped and target.goes_on(10.0), f"{target.folder} is gone" in target.told()
    seen = f"made again by accident: {not stopped}; told: {told}; goes on when it is back: {held}"
    return held and told, seen


def full_disk(target: Target) -> Seen:
    master = target.master
    before = master.rlimit(psutil.RLIMIT_FSIZE)
    master.rlimit(psutil.RLIMIT_FSIZE, (1, before[1]))  # what it says has no room either
    until_s, taken, stands = time.monotonic() + 15.0, -1.0, False
    while not stands and time.monotonic() < until_s:
        stands, taken = target.numbers()["episodes"] == taken, target.numbers()["episodes"]
        time.sleep(3.0)
    master.rlimit(psutil.RLIMIT_FSIZE, before)
    held = target.goes_on(10.0) and target.master.pid == master.pid
    told = "batches are taken in" in target.told()
    return stands and held, f"it stands: {stands}; with room again it goes on: {held}; told: {told}"


def frozen(target: Target) -> Seen:
    master = target.master
    master.suspend()
    time.sleep(8.0)
    master.resume()
    held = target.goes_on(10.0) and target.master.pid == master.pid
    return held, "it goes on" if held else "it does not go on"


OWN: list[Attack] = [
    ("5", "another user at the sockets", "1", sockets_of_others),
    ("held", "two masters on one folder", "1", second_master),
    ("2", "the largest numbers, then kill -9", "1 kill", killed_after_huge_numbers),
    ("8", "the journal unlinked, then kill -9", "1 kill", killed_after_unlink),
    ("8", "the run folder taken away", "3 s", folder_away),
    ("held", "a full disk", "until it stands", full_disk),
    ("held", "SIGSTOP", "8 s", frozen),
]


def wrong_batch_in_lockstep(target: Target) -> Seen:
    setup = target.setup
    spec, rounds = EpisodeSpec.of(setup), 0
    with Client(str(target.folder), "player", 0, setup.fingerprints(), spec) as client:
        late = Timer(20.0, client.stop, ["it takes too long"])
        late.start()
        client.join()
        order = client.wait_for_order(None)
        if order is not None and client.send(episodes_of(setup, 2), order.version):
            while rounds < 3 and (order := client.wait_for_order(order)) is not None:
                client.send(episodes_of(setup, order.episodes), order.version)
                rounds += 1
        late.cancel()
    return rounds == 3, f"{rounds} of 3 rounds after it"


LOCKSTEP: list[Attack] = [("6", "another batch than was ordered", "1", wrong_batch_in_lockstep)]


# All of them


def tried(attacks: Iterable[Attack], target: Any) -> Iterator[dict[str, Any]]:
    """Each attack with its outcome, as a row; an attack that fails has not held."""
    for row, what, count, strike in attacks:
        begun = time.monotonic()
        try:
            held, seen = strike(target)
        except Exception as error:  # noqa: BLE001  # a training that is gone answers with anything
            held, seen = False, repr(error)
        took = time.monotonic() - begun
        said = "held" if held else "NOT HELD"
        print(f"{row:>4} {what}: {said} ({took:.1f} s), {seen}", flush=True)
        yield {"attack": f"{row}: {what}", "tried": count, "held": held, "seen": seen}


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
    live, own, straight = folder / "live", folder / "a=run of ü", folder / "straight"
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(OPEN_FILES, hard), hard))
    with training(live, "max_updates=0", *ON_A_PORT, *SETTINGS, OFTEN) as target:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        rows = list(tried(FILES, folder))
        target.goes_on(UPDATES, "updates")
        rows += tried(LIVE, target)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    result = result_of(live)
    undisturbed = start_training(straight, f"max_updates={result['updates']}", *SETTINGS)
    rows += harmed(own)
    lockstep = ("service.mode=lockstep", "workers=1", "max_updates=0", "sim=kinematic")
    with training(folder / "lockstep", *lockstep, name="master") as target:
        rows += tried(LOCKSTEP, target)
    undisturbed.wait()
    scores = {"attacked": result["mean_reward"], "undisturbed": result_of(straight)["mean_reward"]}
    no_worse = scores["attacked"] >= scores["undisturbed"] - NOISE
    rows.append(
        {
            "attack": "the score of the training",
            "tried": f"{result['updates']:,} updates",
            "held": no_worse,
            "seen": f"{scores['attacked']:.4f}, undisturbed {scores['undisturbed']:.4f}",
        }
    )
    show("attacks", [row | {"held": "yes" if row["held"] else "NO"} for row in rows])
    held, took = sum(row["held"] for row in rows), time.monotonic() - begun
    print(f"tried {len(rows)}, held {held}, in {took:.0f} s")
    write(out, {"rows": rows, "tried": len(rows), "held": held, "seconds": took, **scores})
    return int(held < len(rows))


def harmed(folder: Path) -> list[dict[str, Any]]:
    """What was done to a training of its own, with an independent witness; the folder is odd."""
    with training(folder, "max_updates=0", *SETTINGS, OFTEN) as target:
        witness, rows = Witness(str(folder), target.setup), list[dict[str, Any]]()
        witness.start()
        target.goes_on(100.0)
        after = 0  # so many it was acknowledged to
        for attack in OWN:
            rows += tried([attack], target)
            after += acknowledged_again(witness)
        witness.stop()
        witness.join(ENDS_S)
    counts = compare(folder, witness)
    held = not (counts["lost"] or counts["doubled"] or witness.error) and after == len(OWN)
    seen = ", ".join(f"{n} {counts[n]:,}" for n in ("acknowledged", "lost", "doubled"))
    seen += f"; acknowledged again after {after} of {len(OWN)}"
    what = "held: kill -9 with a witness, in an odd folder"
    return [*rows, {"attack": what, "tried": "2 kills", "held": held, "seen": seen}]


def acknowledged_again(witness: Witness) -> bool:
    """Whether more of what a witness plays is acknowledged from now on."""
    before, until_s = witness.acknowledged, time.monotonic() + ENDS_S
    while witness.acknowledged == before and witness.is_alive() and time.monotonic() < until_s:
        time.sleep(0.1)
    return witness.acknowledged > before
