"""Small runs that the tests of the master share: everything real but the sockets."""

import errno
import io
import os
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from master.checkpointer import Checkpointer
from master.config import MasterConfig
from master.hub.registry import Peer
from master.learn.budget import Budget
from master.learn.divergence import DivergenceGuard
from master.learn.lockstep import Lockstep
from master.learn.trainer import Trainer
from master.loop import Loop
from master.record import journal as journal_module
from master.record.delivery import EpisodesArrived, Ledger
from master.record.journal import Journal, Place
from master.record.rundir import Claim, Clock, Record, RunFolder
from master.signals import StopSignals
from master.watch.metrics import Metrics
from master.watch.report import Reporter, StatusCollector
from tangram_core.agent import Weights
from tangram_core.run.process import Watchdog
from tangram_core.run.service import ServiceConfig
from tangram_core.setup import Setup
from tangram_core.wire.messages import PICTURE_WIDTH, EpisodeBatch, Go, RunStatus, Scores
from tests.agent.builders import random_episodes, setup

# Small tensors on several threads wait for cores that others use, a hundred times longer.
torch.set_num_threads(1)

AGENT: dict[str, Any] = {
    "batch_size": 4,
    "replay_capacity": 64,
    "learning_starts": 4,
    "updates_per_transition": 0.5,
    "hindsight": [{"strategy": "final"}, {"strategy": "near", "position": 0.1, "angle": 0.5}],
}


def arrival(made: Setup, sequence: int, count: int = 4, version: int = 0) -> EpisodesArrived:
    """A batch of random episodes from player 0."""
    episodes = random_episodes(made, count, seed=sequence)
    batch = EpisodeBatch(sequence, version, episodes)
    return EpisodesArrived("player", 0, 1, batch, batch.encode(made.spec))


def scores(made: Setup, version: int, reward: float = 0.5) -> Scores:
    """An evaluation with a picture."""
    picture = np.full((120, PICTURE_WIDTH, 3), 200, np.uint8)
    scalars = {"mean_reward": reward, "coverage": 0.75, "episodes": 100.0}
    return Scores(version, scalars, picture)


_opened: list[Journal | Claim] = []


def journal(
    folder: Path, made: Setup, sync_s: float = 1.0, number: int = 0, torn: int | None = None
) -> Journal:
    """A journal of the run `run`, after so many batches."""
    opened = Journal(folder, "run", made.task_digest(), sync_s, Place(number=number), torn=torn)
    _opened.append(opened)
    return opened


class Disk:
    """Writes journals as long as there is room."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.room = 10**9
        opened, disk = journal_module.FileIO, self

        class Full(opened):  # type: ignore[misc, valid-type]
            def write(self, data: memoryview) -> int:
                if not disk.room:
                    raise OSError(errno.ENOSPC, "No space left on device")
                size = min(len(data), disk.room)
                disk.room -= size
                return int(os.write(self.fileno(), data[:size]))

        monkeypatch.setattr(journal_module, "FileIO", Full)


def close_journals() -> None:
    """All that were made here."""
    while _opened:
        _opened.pop().close()


class FakeHub:
    """Scripted arrivals in place of sockets; notes what the loop does, in order.

    Attributes:
        script: what the next polls return; afterwards nothing comes.
        log: ("publish", version), ("acknowledge", sequence), ("stop", reason).
        scored: evaluate every published version like an evaluator would.
    """

    endpoint, weights_endpoint = "tcp://127.0.0.1:1", "tcp://127.0.0.1:2"
    open_to_all = False
    broadcast_s = 0.0

    def discards(self, arrival: EpisodesArrived) -> bool:
        """Whether the batch's key was revoked."""
        return arrival.owner == "revoked"

    def __init__(
        self, made: Setup, script: Iterable[list[Any]] = (), roles: Iterable[str] = ("player",)
    ) -> None:
        self.made = made
        self.script = deque(script)
        now = time.monotonic()
        self.peers = [Peer(r, i, 1, f"p{i}", b"", now, Ledger(1)) for i, r in enumerate(roles)]
        self.counters: Counter[str] = Counter()
        self.log: list[tuple[str, Any]] = []
        self.polls = 0
        self.on_poll = lambda: None

    def count(self, role: str) -> int:
        return sum(peer.role == role for peer in self.peers)

    def poll(self, timeout_s: float) -> list[Any]:
        self.polls += 1
        assert self.polls < 10_000, "the loop does not end"
        self.on_poll()
        return self.script.popleft() if self.script else []

    def acknowledge(self, arrived: EpisodesArrived) -> None:
        self.log.append(("acknowledge", arrived.sequence))

    def publish(self, weights: Weights) -> None:
        assert all(np.isfinite(tensor).all() for tensor in weights.tensors.values())
        self.log.append(("publish", weights.version))

    def order(self, orders: Mapping[int, Go]) -> None:
        self.log.append(("order", dict(orders)))

    def tell(self, status: RunStatus) -> None:
        self.log.append(("tell", status))

    def stop(self, reason: str) -> None:
        self.log.append(("stop", reason))
        self.peers = []

    def state(self) -> dict[str, dict[str, int]]:
        return {"player/0": {"incarnation": 1, "sequence": len(self.values("acknowledge"))}}

    def close(self) -> None:
        self.log.append(("close", None))

    def values(self, kind: str) -> list[Any]:
        """What was done of one kind, in order."""
        return [value for name, value in self.log if name == kind]


class ShownProgress:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.statuses: list[RunStatus] = []

    def show(self, status: RunStatus) -> None:
        self.statuses.append(status)

    def close(self) -> None:
        pass


def small_setup(**agent: Any) -> Setup:
    """A setup whose updates take milliseconds."""
    return setup(agent=AGENT | agent)


def trainer(made: Setup, seed: int = 0, lag_updates: int = 2) -> Trainer:
    """A trainer on the CPU."""
    return Trainer(made, seed, "cpu", lag_updates)


def loop(
    folder: Path,
    made: Setup,
    hub: FakeHub,
    service: dict[str, Any] | None = None,
    lag_updates: int = 2,
    **config: Any,
) -> Loop:
    """A loop around a fake hub, in a run folder that exists."""
    given = {"publish_seconds": 1000.0} if service is None else service
    settings = MasterConfig(str(folder), service=ServiceConfig(**given), **config)
    run_folder = RunFolder(folder)
    run_folder.prepare("auto")
    run_folder.write_config({})
    learner = trainer(made, lag_updates=lag_updates)
    service, record = settings.service, Record()
    guard = DivergenceGuard(learner, run_folder.bad_batch, limit=3)
    clock, budget = Clock(record), Budget(settings, learner, record)
    kept = journal(run_folder.journal, made)
    claim = run_folder.lock()
    _opened.append(claim)
    checkpointer = Checkpointer(service, claim, guard, hub, kept, clock)  # type: ignore[arg-type]
    status = StatusCollector("run", guard, hub, budget, clock, checkpointer)  # type: ignore[arg-type]
    metrics = Metrics(run_folder.tensorboard, run_folder.curve)
    shown = ShownProgress(), metrics, [hub.tell], run_folder.picture
    reporter = Reporter(learner, record, status, *shown)
    return Loop(
        service=service,
        folder=run_folder,
        hub=hub,  # type: ignore[arg-type]
        guard=guard,
        lockstep=Lockstep.of(service, settings.workers, made.spec),
        budget=budget,
        clock=clock,
        checkpointer=checkpointer,
        reporter=reporter,
        signals=StopSignals(),
        watchdog=Watchdog(0.0),
    )


def shown(made: Loop) -> list[RunStatus]:
    """What the loop showed its user."""
    progress = made.reporter._progress
    assert isinstance(progress, ShownProgress)
    return progress.statuses


def play_on(made: Trainer, rounds: int, seed: int = 0, count: int = 4) -> None:
    """Insert and learn in turns; hindsight and sampling draw from the trainer's generators."""
    for i in range(rounds):
        made.insert(random_episodes(made.setup, count, seed=1000 * seed + i))
        while made.rate_limiter.may_update():
            made.update(i / rounds)


def assert_same_state(one: Trainer, other: Trainer) -> None:
    """Every array and every counter is equal to the last bit."""
    (ours, counters), (theirs, their_counters) = one.state(), other.state()
    assert counters == their_counters
    assert ours.keys() == theirs.keys()
    for stem, arrays in ours.items():
        assert arrays.keys() == theirs[stem].keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(array, theirs[stem][name], err_msg=name)


def screen(**settings: Any) -> Console:
    """A terminal or a file of 100 columns."""
    return Console(file=io.StringIO(), width=100, **settings)


def text(shown: Console) -> str:
    """All that was written to it."""
    assert isinstance(shown.file, io.StringIO)
    return shown.file.getvalue()
