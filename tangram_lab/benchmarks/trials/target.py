"""The training under attack, and functions that run attacks and report their outcomes."""

import json
import os
import statistics
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psutil
import yaml
import zmq

from master.config import KeysConfig
from master.hub.giving import change_keys
from tangram_core.errors import TangramError
from tangram_core.setup import Setup, make_setup
from tangram_core.spec import Episodes
from tangram_core.store.checkpoints import list_checkpoints, load_checkpoint
from tangram_core.wire.arrays import columns
from tangram_core.wire.messages import Hello
from tangram_core.wire.schema import opened, seal
from tangram_lab.benchmarks.trainings import (
    MIB,
    PATIENCE_S,
    command,
    processes_of,
    start_training,
    wait_for,
)
from tangram_lab.benchmarks.trials.chaos import SETTINGS
from worker.status import ask_status
from worker.talk.discovery import find_master

Seen = tuple[bool, str]  # whether the training held, and what was observed
# Kind of attack, description, amount, and the function that attacks.
Attack = tuple[str, str, str, Callable[[Any], Seen]]
Rows = list[dict[str, Any]]
OFTEN = "service.checkpoint_minutes=0.05"
# Small batches: a worker must wait until the learner has accepted the earlier ones.
OURS = (*SETTINGS, "service.envs=4")
ROOM_MIB = 64.0  # allowed growth of the master's memory under an attack
ENDS_S = 60.0
LOOK_S = 0.1
KEYS_S = 1.5  # the master reads the list of keys once a second
HOST = "127.0.0.1"


@dataclass
class Growth:
    """Growth of a process.

    Attributes:
        mib: largest growth of resident memory, in MiB.
        files: median growth of open files; on a busy machine many may open at once.
    """

    mib: float = 0.0
    files: int = 0


@dataclass
class Target:
    """A training under attack.

    Attributes:
        folder: run folder.
        launcher: process of tangram-train, or of a master alone.
        context: ZeroMQ context for sockets to the master.
    """

    folder: Path
    launcher: "subprocess.Popen[bytes]"
    context: "zmq.Context[zmq.Socket[bytes]]"

    @property
    def where(self) -> dict[str, Any]:
        """The content of the connection file."""
        content: dict[str, Any] = json.loads((self.folder / "connection.json").read_text())
        return content

    @cached_property
    def setup(self) -> Setup:
        """Task, agent and service of the run, from its config."""
        return make_setup(yaml.safe_load((self.folder / "config.yaml").read_text()))

    @property
    def master(self) -> psutil.Process:
        """The process of the master."""
        return self.process("tangram-master")

    def process(self, words: str) -> psutil.Process:
        """A process of the run whose title contains `words`; TangramError if there is none."""
        found = [p for p, line in processes_of(self.folder).items() if words in line]
        if not found:
            raise TangramError(f"there is no {words}")
        return found[0]

    def numbers(self) -> Mapping[str, float]:
        """Name -> number in the status; TangramError if the master does not answer."""
        return ask_status(str(self.folder), self.context, 5.0).numbers

    def goes_on(self, more: float = 1.0, name: str = "episodes") -> bool:
        """Whether the number `name` in the status grows by `more` in time."""
        until_s, goal = time.monotonic() + PATIENCE_S, float("inf")
        while time.monotonic() < until_s:
            with suppress(TangramError):
                value = self.numbers()[name]
                goal = min(goal, value + more)
                if value >= goal:
                    return True
            time.sleep(LOOK_S)
        return False

    def told(self) -> str:
        """All output of launcher and master so far."""
        return (self.folder / "told").read_text(errors="replace")

    @contextmanager
    def cost(self) -> Iterator[Growth]:
        """Measure the growth of the master inside this context; it is complete at the end."""
        process, most, ends = self.master, Growth(), Event()
        mib, files, seen = process.memory_info().rss / MIB, process.num_fds(), [0]

        def look() -> None:
            with suppress(psutil.Error):
                while not ends.wait(0.02):
                    most.mib = max(most.mib, process.memory_info().rss / MIB - mib)
                    seen.append(process.num_fds() - files)

        watch = Thread(target=look, daemon=True)
        watch.start()
        try:
            yield most
        finally:
            ends.set()
            watch.join()
            most.files = int(statistics.median(seen))

    @property
    def points(self) -> Path:
        """The folder of checkpoints."""
        return self.folder / "checkpoints"

    def given(self, name: str, role: str = "player") -> Path:
        """The connection file of user `name` with an own key; made if it does not exist."""
        file = self.folder.with_name(f"{name}.json")
        if not file.exists():
            change_keys(KeysConfig(str(self.folder), add=name, role=role, out=str(file)))
            time.sleep(KEYS_S)
        return file

    @contextmanager
    def peer(
        self, kind: int = zmq.DEALER, role: str = "player", file: Path | None = None, **options: int
    ) -> Iterator[Any]:
        """A connected socket with the keys of a role from the run or from a connection file.

        An unknown role gets new keys, which the master does not know; an empty role gets no keys.
        """
        where, address = self.where, find_master(str(file or self.folder))
        with self.context.socket(kind) as one:
            one.setsockopt(zmq.LINGER, 0)
            one.setsockopt(zmq.SNDTIMEO, 5000)  # the master may have ended
            if address is not None and address.keys and role:
                made = (key.decode() for key in zmq.curve_keypair())
                public, secret = address.keys.get(role, made)
                one.setsockopt(zmq.CURVE_SERVERKEY, address.server_key.encode())
                one.setsockopt(zmq.CURVE_PUBLICKEY, public.encode())
                one.setsockopt(zmq.CURVE_SECRETKEY, secret.encode())
            for name, value in options.items():
                one.setsockopt(getattr(zmq, name), value)
            one.connect(where["endpoint" if kind == zmq.DEALER else "weights_endpoint"])
            yield one

    def ask(
        self,
        *messages: list[bytes],
        role: str = "player",
        unanswered: int = 0,
        file: Path | None = None,
    ) -> Counter[str]:
        """Send messages on a new connection and count the answers by kind.

        Waits for one answer to each message, except for `unanswered` of them.
        """
        answers, count = Counter[str](), len(messages) - unanswered
        with self.peer(role=role, file=file) as one:
            for frames in messages:
                one.send_multipart(frames)
            while answers.total() < count and one.poll(2000):
                answers[opened(one.recv_multipart())["kind"]] += 1
        return answers

    def port(self, name: str) -> tuple[str, int]:
        """Host and port of an endpoint, by its name in the connection file."""
        return HOST, urlsplit(self.where[name]).port or 0

    def hello(self, **fields: object) -> list[bytes]:
        """The frames of a HELLO of a player; `fields` replace valid values by forged ones."""
        own: dict[str, object] = {"role": "player", "index": 3000, "incarnation": 0}
        own |= {"process": "attacker", "first": 1, "fingerprints": self.setup.fingerprints()}
        return seal(Hello.kind, {**own, "run_id": self.where["run_id"], **fields}, [])

    def cheap(self, deed: Callable[[], object], room_mib: float = ROOM_MIB) -> Seen:
        """Whether an attack costs at most `room_mib` MiB and the same master process goes on."""
        pid = self.master.pid
        with self.cost() as most:
            deed()
        same = self.goes_on() and self.master.pid == pid
        seen = f"+{most.mib:.0f} of {room_mib:g} MiB, the master {'goes on' if same else 'is gone'}"
        return same and most.mib <= room_mib, seen

    def newest(self) -> str:
        """Name of the newest checkpoint; empty before the first."""
        return next((one.name for one in reversed(list_checkpoints(self.points))), "")

    def checkpoint(self) -> Mapping[str, Any]:
        """Wait for a checkpoint that begins after this call, and return its counters."""
        seen, until_s = {self.newest()}, time.monotonic() + ENDS_S
        while len(seen) < 3 and time.monotonic() < until_s:  # the first may have begun before
            seen.add(self.newest())
            time.sleep(LOOK_S / 2)
        return load_checkpoint(self.points / self.newest(), []).counters


@contextmanager
def started(
    folder: Path, *settings: str, name: str = "train"
) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a training inside this context; it is terminated at the end."""
    launcher = start_training(folder, *settings, name=name)
    try:
        yield launcher
    finally:
        launcher.terminate()
        launcher.wait(ENDS_S)


@contextmanager
def training(folder: Path, *settings: str, name: str = "train") -> Iterator[Target]:
    """Run a training inside this context, which begins once the training can be reached."""
    with started(folder, *settings, name=name) as launcher, zmq.Context() as context:
        wait_for(folder / "connection.json", launcher)
        context.set(zmq.MAX_SOCKETS, 4096)
        yield Target(folder, launcher, context)


def episodes_of(setup: Setup, count: int) -> Episodes:
    """Random episodes of the right shapes, not played in the task."""
    dice = np.random.default_rng(0)
    return Episodes(
        {
            one.name: dice.uniform(0.0, 0.4, one.shape).astype(one.dtype)
            for one in columns(setup.spec, count)
        }
    )


def until(done: Callable[[], object], within_s: float = ENDS_S) -> bool:
    """Wait until `done` returns true; False after `within_s`. An error counts as not done yet."""
    until_s = time.monotonic() + within_s
    while time.monotonic() < until_s:
        with suppress(TangramError, psutil.Error, OSError):
            if done():
                return True
        time.sleep(LOOK_S)
    return False


def one_line(*arguments: str, cwd: Path, status: int = 2) -> Seen:
    """Whether a command ends with this exit status and one line of error text."""
    done = subprocess.run(
        [*command(arguments[0]), *arguments[1:]],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=ENDS_S,
        check=False,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )
    lines = done.stderr.strip().splitlines()
    return (done.returncode, len(lines)) == (
        status,
        1,
    ), f"{len(lines)} lines: {' '.join(lines)[-90:]}"


def tried(attacks: Iterable[Attack], target: Any) -> Iterator[dict[str, Any]]:
    """Run attacks and yield a row for each; an exception counts as "not held"."""
    for row, what, count, strike in attacks:
        begun = time.monotonic()
        try:
            held, seen = strike(target)
        except Exception as error:  # noqa: BLE001  # a broken training may cause any error
            held, seen = False, repr(error)
        took = time.monotonic() - begun
        said = "held" if held else "NOT HELD"
        print(f"{row:>4} {what}: {said} ({took:.1f} s), {seen}", flush=True)
        yield {"attack": f"{row}: {what}", "tried": count, "held": held, "seen": seen}
