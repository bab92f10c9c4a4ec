"""What is attacked: a training, or files; and how an attack is told."""

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

Seen = tuple[bool, str]
Attack = tuple[str, str, str, Callable[[Any], Seen]]  # row, what, how much, and what does it
Rows = list[dict[str, Any]]
OFTEN = "service.checkpoint_minutes=0.05"
# Whoever sends a batch waits until the learner has taken in those before: small ones.
OURS = (*SETTINGS, "service.envs=4")
ROOM_MIB = 64.0  # that the memory of a master may grow by under any attack
ENDS_S = 60.0
LOOK_S = 0.1
KEYS_S = 1.5  # the master looks once in a second who has a key
HOST = "127.0.0.1"


@dataclass
class Growth:
    """What a process has grown by.

    Attributes:
        mib: of memory, the most.
        files: that it has open, at the median: on a busy machine all may come at once.
    """

    mib: float = 0.0
    files: int = 0


@dataclass
class Target:
    """A training under attack.

    Attributes:
        folder: of the run.
        launcher: tangram-train, or a master alone.
        context: of the sockets that ask it.
    """

    folder: Path
    launcher: "subprocess.Popen[bytes]"
    context: "zmq.Context[zmq.Socket[bytes]]"

    @property
    def where(self) -> dict[str, Any]:
        """What its connection file says."""
        content: dict[str, Any] = json.loads((self.folder / "connection.json").read_text())
        return content

    @cached_property
    def setup(self) -> Setup:
        """Its task."""
        return make_setup(yaml.safe_load((self.folder / "config.yaml").read_text()))

    @property
    def master(self) -> psutil.Process:
        """The process that learns."""
        return self.process("tangram-master")

    def process(self, words: str) -> psutil.Process:
        """One of the run whose title holds these words; TangramError if there is none."""
        found = [p for p, line in processes_of(self.folder).items() if words in line]
        if not found:
            raise TangramError(f"there is no {words}")
        return found[0]

    def numbers(self) -> Mapping[str, float]:
        """Those of its status; TangramError where it does not answer."""
        return ask_status(str(self.folder), self.context, 5.0).numbers

    def goes_on(self, more: float = 1.0, name: str = "episodes") -> bool:
        """Whether so many more of something come in time."""
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
        """All lines of launcher and master."""
        return (self.folder / "told").read_text(errors="replace")

    @contextmanager
    def cost(self) -> Iterator[Growth]:
        """What the master grows by."""
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
        """The folder of its checkpoints."""
        return self.folder / "checkpoints"

    def given(self, name: str) -> Path:
        """The connection file of somebody who has a key of his own."""
        file = self.folder.with_name(f"{name}.json")
        if not file.exists():
            change_keys(KeysConfig(str(self.folder), add=name, out=str(file)))
            time.sleep(KEYS_S)
        return file

    @contextmanager
    def peer(
        self, kind: int = zmq.DEALER, role: str = "player", file: Path | None = None, **options: int
    ) -> Iterator[Any]:
        """A socket with the keys of a role; of an unknown role, with new ones; of none, without.

        The keys are the run's own, or those of a connection file.
        """
        where, address = self.where, find_master(str(file or self.folder))
        with self.context.socket(kind) as one:
            one.setsockopt(zmq.LINGER, 0)
            one.setsockopt(zmq.SNDTIMEO, 5000)  # it may be gone
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
        """The kinds of the answers that a new connection gets, to all but so many messages."""
        answers, count = Counter[str](), len(messages) - unanswered
        with self.peer(role=role, file=file) as one:
            for frames in messages:
                one.send_multipart(frames)
            while answers.total() < count and one.poll(2000):
                answers[opened(one.recv_multipart())["kind"]] += 1
        return answers

    def port(self, name: str) -> tuple[str, int]:
        """Where something listens, as its connection file has it."""
        return HOST, urlsplit(self.where[name]).port or 0

    def hello(self, **fields: object) -> list[bytes]:
        """A HELLO of a player, with fields that no worker would send."""
        own: dict[str, object] = {"role": "player", "index": 3000, "incarnation": 0}
        own |= {"process": "attacker", "first": 1, "fingerprints": self.setup.fingerprints()}
        return seal(Hello.kind, {**own, "run_id": self.where["run_id"], **fields}, [])

    def cheap(self, deed: Callable[[], object], room_mib: float = ROOM_MIB) -> Seen:
        """Whether a deed costs little memory, and the same master goes on."""
        pid = self.master.pid
        with self.cost() as most:
            deed()
        same = self.goes_on() and self.master.pid == pid
        seen = f"+{most.mib:.0f} of {room_mib:g} MiB, the master {'goes on' if same else 'is gone'}"
        return same and most.mib <= room_mib, seen

    def newest(self) -> str:
        """Name of the newest checkpoint, empty before the first."""
        return next((one.name for one in reversed(list_checkpoints(self.points))), "")

    def checkpoint(self) -> Mapping[str, Any]:
        """The counters of a checkpoint that begins from now on."""
        seen, until_s = {self.newest()}, time.monotonic() + ENDS_S
        while len(seen) < 3 and time.monotonic() < until_s:  # one may be on its way
            seen.add(self.newest())
            time.sleep(LOOK_S / 2)
        return load_checkpoint(self.points / self.newest(), []).counters


@contextmanager
def started(
    folder: Path, *settings: str, name: str = "train"
) -> Iterator["subprocess.Popen[bytes]"]:
    """A training until the end of the block, which ends it in order."""
    launcher = start_training(folder, *settings, name=name)
    try:
        yield launcher
    finally:
        launcher.terminate()
        launcher.wait(ENDS_S)


@contextmanager
def training(folder: Path, *settings: str, name: str = "train") -> Iterator[Target]:
    """The same, once it can be reached."""
    with started(folder, *settings, name=name) as launcher, zmq.Context() as context:
        wait_for(folder / "connection.json", launcher)
        context.set(zmq.MAX_SOCKETS, 4096)
        yield Target(folder, launcher, context)


def episodes_of(setup: Setup, count: int) -> Episodes:
    """Episodes of the right shapes; nobody has played them."""
    dice = np.random.default_rng(0)
    return Episodes(
        {
            one.name: dice.uniform(0.0, 0.4, one.shape).astype(one.dtype)
            for one in columns(setup.spec, count)
        }
    )


def until(done: Callable[[], object], within_s: float = ENDS_S) -> bool:
    """Wait for something; False if it does not come in time. What fails has not come yet."""
    until_s = time.monotonic() + within_s
    while time.monotonic() < until_s:
        with suppress(TangramError, psutil.Error, OSError):
            if done():
                return True
        time.sleep(LOOK_S)
    return False


def one_line(*arguments: str, cwd: Path, status: int = 2) -> Seen:
    """Whether a command refuses in one line, with an exit status."""
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
