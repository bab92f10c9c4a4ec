"""Histories of masters, workers and disks: acknowledged is inserted, once, in order."""

import os
import shutil
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from io import FileIO
from pathlib import Path
from random import Random
from tempfile import mkdtemp
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from master import run as run_module
from master.config import MasterConfig
from master.hub import hub as hub_module
from master.hub import sockets as sockets_module
from master.hub.security import Holder
from master.hub.sockets import Received
from master.loop import Loop
from master.record import journal as journal_module
from master.record.counters import Counters
from master.record.rundir import RunFolder
from master.run import open_run
from master.signals import StopSignals
from tangram_core.errors import TangramError, WireError
from tangram_core.run.process import Watchdog
from tangram_core.run.service import ServiceConfig
from tangram_core.spec import Episodes
from tangram_sim.config import RewardConfig
from tests.agent.builders import random_episodes
from tests.agent.no_reward import NOTHING
from tests.master.builders import ShownProgress, small_setup
from tests.master.record.power import Machine, PowerCutError
from worker.talk import client as client_module
from worker.talk.client import Client
from worker.talk.connection import Timing

SMALL = small_setup(replay_capacity=4096, updates_per_transition=0.01)
MADE = replace(SMALL, task=replace(SMALL.task, reward=RewardConfig(NOTHING)))
SPEC = MADE.spec
AT_ONCE = Timing(retry_s=0.0, resend_s=0.0, heartbeat_s=1000.0)
FIRST_TAG = 2.0  # rewards of hindsight twins are 0
WORKERS, ON_THE_WAY = 3, 12
CHANCE = st.integers(0, 2**16)
EXAMPLES = int(os.environ.get("TANGRAM_HISTORIES", "15"))


class Wire:
    """In place of a worker's connection and its sockets: messages wait until they are delivered."""

    def __init__(self, *_: object) -> None:
        self.sockets, self.place, self.keys_refused = self, "here", False
        self.address = SimpleNamespace(run_id="", endpoint="tcp://127.0.0.1:1")
        self.sent, self.answers = list[list[bytes]](), deque[list[bytes]]()
        for name in ("asked", "answered", "watch", "check_lost", "wait", "subscribe", "close"):
            setattr(self, name, lambda *_: None)
        self.open = lambda: False
        self.is_dead = lambda *_: False
        self.weights = lambda: None

    def send(self, frames: Sequence[bytes]) -> bool:
        self.sent = [*self.sent, list(frames)][-ON_THE_WAY:]
        return True

    def messages(self) -> Iterator[list[bytes]]:
        while self.answers:
            yield self.answers.popleft()


class Sockets(sockets_module.Sockets):
    """In place of the master's: takes what is delivered, and answers at once."""

    endpoint, weights_endpoint = "tcp://127.0.0.1:1", "tcp://127.0.0.1:2"

    def __init__(self, *_: object, **__: object) -> None:
        self._counters, self._authenticator = Counters(), None
        self.arriving = deque[tuple[bytes, list[bytes]]]()
        self.wires: dict[bytes, Wire] = {}
        self.publish = self.close = lambda *_: None  # type: ignore[method-assign]

    def wait(self, _timeout_s: float) -> bool:
        return bool(self.arriving)

    def receive(self) -> Received | None:
        return Received(*self.arriving.popleft(), Holder(), "") if self.arriving else None

    def revoked(self) -> list[Holder]:
        return []

    def send(self, identity: bytes, frames: Sequence[bytes]) -> None:
        if identity in self.wires:
            self.wires[identity].answers.append(list(frames))


class Worker:
    """A real client that knows what it sent."""

    def __init__(self, number: int, index: int) -> None:
        self.identity, self.number, self.alive = b"w%d" % number, number, True
        self.harmed = 0  # messages, each of which may be refused once as none
        prints = MADE.fingerprints()
        self.client = Client("here", "player", index, prints, SPEC, None, 4, AT_ONCE)
        wire = self.client._connection
        assert isinstance(wire, Wire)
        self.wire = wire

    def tag(self, sequence: int) -> float:
        return FIRST_TAG + 1000.0 * self.number + sequence

    @property
    def acknowledged(self) -> list[float]:
        """Tags of what the client has no more."""
        kept = self.client.outbox._messages
        return [self.tag(n) for n in range(1, self.client.outbox.next) if n not in kept]

    def does(self, act: Callable[[], object]) -> None:
        """Until the master sends it home, or is one of another run."""
        try:
            act()
        except WireError:  # it would send what nobody takes
            raise
        except TangramError:
            self.alive = False
        self.alive = self.alive and not self.client.stopped
        assert self.client.counters["rejected"] <= self.harmed

    def plays(self) -> None:
        sequence = self.client.outbox.next
        episodes = random_episodes(MADE, 1, seed=sequence)
        rewards = np.full_like(episodes.rewards, self.tag(sequence))
        self.client.send(Episodes({**episodes.arrays, "rewards": rewards}), -1)


class Torn(FileIO):
    """Writes so many bytes more, and then the process is killed."""

    room = 10**9

    def write(self, data: Any) -> int:
        size = min(len(data), Torn.room)
        Torn.room -= size
        written = os.write(self.fileno(), data[:size])
        if written < len(data):
            raise PowerCutError
        return written


class Histories(RuleBasedStateMachine):
    """One run, its workers, and what happens to them."""

    @initialize(synced=st.booleans())
    def begin(self, synced: bool) -> None:
        self.patch, self.place = pytest.MonkeyPatch(), Path(mkdtemp(prefix="history-"))
        self.patch.setattr(hub_module, "Sockets", Sockets)
        self.patch.setattr(client_module, "Connection", Wire)
        self.patch.setattr(run_module, "Metrics", MagicMock())
        self.patch.setattr(journal_module, "FileIO", Torn)
        self.synced, self.workers = synced, list[Worker]()
        self.machine = Machine(self.place, self.patch)
        self.start()
        for index in (0, 1):
            self.joins(index)
            self.talk(self.workers[-1])
        self.play(self.workers[0], 1)
        self.talk(self.workers[0])  # a run that has no batch yet is begun anew

    # The master

    def start(self) -> None:
        """A life of the master, from what lies there."""
        Torn.room, self.machine.cut_at = 10**9, 0
        sync_s = 0.0 if self.synced else 1000.0
        service = ServiceConfig(http_port=-1, journal_sync_seconds=sync_s)
        folder = RunFolder(self.machine.folder / "run")
        folder.prepare("auto")
        self.claim, opened = folder.lock(), ExitStack()
        config = MasterConfig(str(folder.path), resume="auto", max_updates=0, service=service)
        more = (ShownProgress(), StopSignals(), Watchdog(0.0), opened)
        self.loop, _ = open_run(config, MADE, self.claim, *more)
        opened.pop_all()  # a kill closes nothing
        self.sockets.wires = {worker.identity: worker.wire for worker in self.workers}

    @property
    def sockets(self) -> Sockets:
        sockets: Any = self.loop.hub._sockets
        assert isinstance(sockets, Sockets)
        return sockets

    def restart(self, power: bool, chance: int = 0) -> None:
        self.loop.checkpointer._journal._drop()
        self.claim.close()
        if power:
            self.machine.restarted(Random(chance))
        self.start()

    def lives(self, act: Callable[[Loop], object], chance: int) -> None:
        try:
            act(self.loop)
        except PowerCutError:
            self.restart(power=self.machine.cut_at > 0, chance=chance)

    def work(self, chance: int, insert: bool = True) -> None:
        def turn(loop: Loop) -> None:
            loop.receive(0.0)
            if insert:
                loop.insert()
                loop.learn()

        self.lives(turn, chance)

    @rule(chance=CHANCE)
    def works(self, chance: int) -> None:
        self.work(chance, insert=chance % 2 > 0)

    @rule(chance=CHANCE)
    def saves(self, chance: int) -> None:
        """Also with batches that have come and are not inserted, and often with an end."""
        self.lives(lambda loop: loop.receive(0.0), chance)
        self.lives(lambda loop: loop.checkpointer.save(), chance)
        if chance % 3 == 0:
            self.restart(power=False)

    @rule(how=st.sampled_from(["now", "while it writes", "power", "power soon"]), chance=CHANCE)
    def is_killed(self, how: str, chance: int) -> None:
        power = self.synced and how.startswith("power")
        if how == "while it writes":
            Torn.room = chance % 2000
        elif power and how == "power soon":
            self.machine.cut_at = self.machine.syncs + 1 + chance % 8
        else:
            self.restart(power, chance)

    # Workers, and what is between

    def one(self, chance: int) -> Worker | None:
        alive = [worker for worker in self.workers if worker.alive]
        return alive[chance % len(alive)] if alive else None

    def play(self, worker: Worker, count: int) -> None:
        for _ in range(count):
            if worker.alive and worker.client.joined and worker.client.window_free:
                worker.does(worker.plays)

    def talk(self, worker: Worker, chance: int = 1) -> None:
        """All that is on its way arrives, and mostly it is inserted and answered."""
        for _ in range(2):
            if worker.alive:
                worker.does(worker.client.poll)
                sent, worker.wire.sent = worker.wire.sent, []
                self.sockets.arriving.extend((worker.identity, frames) for frames in sent)
                self.work(chance, insert=chance % 3 > 0)
                worker.does(worker.client.poll)

    @rule(index=st.integers(-1, 1))
    def joins(self, index: int) -> None:
        """Perhaps in the place of another one, which goes on for a while."""
        if sum(worker.alive for worker in self.workers) < WORKERS:
            made = Worker(len(self.workers), index)
            made.client._say_hello(made.wire, 0.0)  # type: ignore[arg-type]
            self.workers.append(made)
            self.sockets.wires[made.identity] = made.wire

    @rule(chance=CHANCE, count=st.integers(1, 4))
    def plays(self, chance: int, count: int) -> None:
        worker = self.one(chance)
        if worker is not None:
            self.play(worker, count)

    @rule(chance=CHANCE, count=st.integers(0, 4))
    def talks(self, chance: int, count: int) -> None:
        worker = self.one(chance)
        if worker is not None:
            self.play(worker, count)
            self.talk(worker, chance)

    @rule(chance=CHANCE)
    def hears(self, chance: int) -> None:
        worker = self.one(chance)
        if worker is not None:
            worker.does(worker.client.poll)

    @rule(chance=CHANCE, at=st.integers(0, ON_THE_WAY), again=st.booleans())
    def is_heard(self, chance: int, at: int, again: bool) -> None:
        """A message arrives, perhaps before others, perhaps once more later."""
        worker = self.one(chance)
        if worker is not None and worker.wire.sent:
            at = min(at, len(worker.wire.sent) - 1)
            sent = worker.wire.sent[at] if again else worker.wire.sent.pop(at)
            self.sockets.arriving.append((worker.identity, sent))

    @rule(chance=CHANCE, up=st.booleans(), cut=st.booleans())
    def is_damaged(self, chance: int, up: bool, cut: bool) -> None:
        """A bit of a message, or its end; neither side takes it for what it was."""
        worker = self.one(chance)
        there = (worker.wire.sent if up else worker.wire.answers) if worker is not None else ()
        if worker is not None and there:
            frames = list(there[0])
            number = chance % len(frames)
            frame = bytearray(frames[number] or b"\0")
            frame[chance % len(frame)] ^= 1 << chance % 8
            frames[number] = bytes(frame[: len(frame) // 2] if cut else frame)
            if up:
                worker.harmed += 1
                self.sockets.arriving.append((worker.identity, frames))
            else:
                worker.wire.answers[0] = frames

    @rule(chance=CHANCE)
    def is_lost(self, chance: int) -> None:
        """What is on its way, and sometimes the worker, too."""
        worker = self.one(chance)
        if worker is not None:
            worker.wire.sent.clear()
            worker.wire.answers.clear()
            worker.alive = chance % 3 > 0

    # What must hold

    @invariant()
    def acknowledged_is_inserted_once_and_in_order(self) -> None:
        rewards = self.loop.guard.trainer.learner.replay.state()["reward"]
        found = [float(tag) for tag in rewards if tag >= FIRST_TAG]
        times = Counter(found)
        assert set(times.values()) <= {1}
        for worker in self.workers:
            assert set(worker.acknowledged) <= times.keys()
            own = [tag for tag in found if 0 < tag - worker.tag(0) < 1000]
            assert own == sorted(own)

    def settle(self) -> None:
        """After another restart, with nothing in the way, all that was kept is taken in."""
        self.restart(power=False)
        for _ in range(4):
            for worker in self.workers:
                self.talk(worker)
        self.acknowledged_is_inserted_once_and_in_order()
        assert not any(worker.client.outbox for worker in self.workers if worker.alive)

    def teardown(self) -> None:
        if hasattr(self, "machine"):
            try:
                self.settle()
            finally:
                self.loop.checkpointer._journal._drop()
                self.claim.close()
                self.machine.close()
                self.patch.undo()
                shutil.rmtree(self.place)


TestHistories = pytest.mark.fast(Histories.TestCase)
TestHistories.settings = settings(max_examples=EXAMPLES, stateful_step_count=60)
