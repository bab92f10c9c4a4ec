"""Random faults in a real training: what recovers, how fast, and whether episodes are lost."""

import os
import random
import signal
import socket
import statistics
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from typing import Any, cast

import numpy as np
import yaml
import zmq

from tangram_core.errors import TangramError
from tangram_core.setup import Setup, make_setup
from tangram_core.store.checkpoints import list_checkpoints, load_checkpoint
from tangram_core.wire.messages import WORKER_COLUMNS, RunStatus
from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.trainings import (
    LOOK_S,
    free_port,
    processes_of,
    result_of,
    start_training,
    wait_for,
)
from tangram_lab.benchmarks.trials.proxy import DOWN, UP, Proxy
from worker.play.rollout import Rollout
from worker.play.session import Acting
from worker.status import ask_status
from worker.talk.client import Client

# A player that stores every episode it sent, and counts acknowledged batches


ENVS = 4
INDEX = 1000


class Witness(Thread):
    """A player thread that plays until `stop` is called or the master ends it.

    Attributes:
        setup: setup of the run.
        sent: for each batch, the keys of its episodes (see `keys`).
        acknowledged: the largest n such that batches 1 to n are all acknowledged.
        error: the error that ended the thread; None without one.
    """

    def __init__(self, connect: str, setup: Setup) -> None:
        super().__init__(name="witness", daemon=True)
        self.sent: list[list[bytes]] = []
        self.acknowledged = 0
        self.error: TangramError | None = None
        self.setup = setup
        self._connect, self._ends = connect, Event()

    def stop(self) -> None:
        """Ask the thread to stop."""
        self._ends.set()

    def run(self) -> None:
        """Play, and store an error in `error`."""
        try:
            self._play()
        except TangramError as error:
            self.error = error

    def _play(self) -> None:
        setup = self.setup
        acting = Acting(setup.agent.actor(setup.task))
        client = Client(
            self._connect,
            "player",
            INDEX,
            setup.fingerprints(),
            setup.spec,
            acting.actor.shapes,
        )
        with closing(setup.task.make(ENVS)) as env, client:
            client.on_progress = lambda: self._look(client)
            if not client.join():
                return
            first = client.wait_for_weights()
            if first is None:
                return
            acting.follow(first)
            me = client.welcome
            rollout = Rollout(env, setup.spec, me.seed, "witness", me.index, me.incarnation)
            while client.wait_for_window():
                newest = client.newest_weights()
                if newest is not None:
                    acting.follow(newest)
                episodes = rollout.play(acting.actor.act)
                self.sent.append(keys(episodes["corners"][:, 0], episodes.actions[:, 0]))
                if not client.send(episodes, acting.version):
                    self.sent.pop()
            self._look(client)

    def _look(self, client: Client) -> None:
        self.acknowledged = client.acknowledged
        if self._ends.is_set():
            client.stop("the trial is over")


def keys(states: np.ndarray, actions: np.ndarray) -> list[bytes]:
    """A key for each episode: the bytes of its first state and action, which are unique."""
    return [
        s.astype("<f4").tobytes() + a.astype("<f4").tobytes()
        for s, a in zip(states, actions, strict=True)
    ]


def compare(folder: Path, witness: Witness) -> dict[str, int]:
    """Count episodes of a witness that are lost or doubled in the last checkpoint of a run.

    The replay buffer must be large enough for the whole run. It holds each episode of one action
    several times: hindsight adds relabelled copies with the same state and action.
    """
    replay = load_checkpoint(list_checkpoints(folder / "checkpoints")[-1]).arrays["replay"]
    found = keys(replay["state"], replay["action"])
    counts = Counter(found)
    copies = 1 + sum(one.copies for one in cast("Any", witness.setup.agent).config.hindsight)
    acknowledged = [key for batch in witness.sent[: witness.acknowledged] for key in batch]
    every = [key for batch in witness.sent for key in batch]
    return {
        "sent": len(every),
        "acknowledged": len(acknowledged),
        "lost": sum(counts[key] < copies for key in acknowledged),
        "doubled": sum(counts[key] > copies for key in every),
        "unacknowledged_but_there": sum(counts[k] > 0 for k in every[len(acknowledged) :]),
    }


# The trial


WORKERS = 2
# One update for each transition: slow enough that the replay buffer holds the whole run.
SETTINGS = (
    f"workers={WORKERS}",
    "agent.updates_per_transition=1.0",
    "agent.replay_capacity=2000000",
    "net.width=32",
    "net.feed_forward=64",
    "service.eval_seconds=20",
    "service.checkpoint_minutes=0.5",
)
TCP = ("service.bind=127.0.0.1", "service.auth=off")  # proxy and garbage need a port without keys
PAUSE_S = (1.0, 5.0)  # between the recovery from one fault and the next
FROZEN_S = (3.0, 15.0)
CUT_S = (5.0, 20.0)
PATIENCE_S = 120.0
# Players send a heartbeat every two seconds, and the status may be a second old.
FRESH_S, SETTLE_S = 3.5, 4.0
EVALUATES, SILENT = WORKER_COLUMNS.index("evaluator"), WORKER_COLUMNS.index("silent_s")
GARBAGE = 200


@dataclass
class Trial:
    """A training with faults.

    Attributes:
        folder: run folder.
        launcher: process of tangram-train.
        proxy: proxy between the witness and the master.
        port: port of the master.
        dice: random generator of the faults.
        context: ZeroMQ context for sockets to the master.
        faults: kind of fault -> seconds until each recovery; infinite without recovery.
    """

    folder: Path
    launcher: "subprocess.Popen[bytes]"
    proxy: Proxy
    port: int
    dice: random.Random
    context: "zmq.Context[zmq.Socket[bytes]]" = field(default_factory=zmq.Context)
    faults: dict[str, list[float]] = field(default_factory=dict)

    def status(self) -> RunStatus | None:
        """The status of the run; None if the master does not answer."""
        try:
            return ask_status(str(self.folder), self.context, 3.0)
        except TangramError:
            return None

    def is_whole(self, updates: float) -> bool:
        """Whether all workers sent a heartbeat lately, and more than `updates` updates are done."""
        now = self.status()
        if now is None:
            return False
        evaluates = now.workers[now.workers[:, SILENT] < FRESH_S, EVALUATES]
        players, evaluators = len(evaluates) - evaluates.sum(), evaluates.sum()
        here = players > WORKERS and evaluators > 0  # the witness is a player, too
        return bool(here) and now.numbers["updates"] > updates

    def pids(self, words: str) -> list[int]:
        """Ids of the processes of the run whose command line contains `words`."""
        return [one.pid for one, line in processes_of(self.folder).items() if words in line]

    def strike(self, kind: str) -> None:
        """Cause one fault, and measure the time until all workers are back and learning goes on."""
        status = self.status()
        before = 0.0 if status is None else status.numbers["updates"]
        KINDS[kind](self)
        begun = time.monotonic()
        time.sleep(SETTLE_S)
        while time.monotonic() - begun < PATIENCE_S and self.launcher.poll() is None:
            if self.is_whole(before):
                break
            time.sleep(LOOK_S)
        took = time.monotonic() - begun
        self.faults.setdefault(kind, []).append(took if took < PATIENCE_S else float("inf"))


def _signal(words: str, number: signal.Signals) -> Callable[[Trial], None]:
    def strike(trial: Trial) -> None:
        for pid in trial.dice.sample(trial.pids(words), k=1) if trial.pids(words) else []:
            os.kill(pid, number)

    return strike


def _freeze(words: str) -> Callable[[Trial], None]:
    def strike(trial: Trial) -> None:
        found = trial.pids(words)
        if not found:
            return
        pid = trial.dice.choice(found)
        os.kill(pid, signal.SIGSTOP)
        time.sleep(trial.dice.uniform(*FROZEN_S))
        os.kill(pid, signal.SIGCONT)

    return strike


def _cut(*directions: str) -> Callable[[Trial], None]:
    def strike(trial: Trial) -> None:
        trial.proxy.cut(*directions)
        time.sleep(trial.dice.uniform(*CUT_S))
        trial.proxy.cut()

    return strike


def _garbage(trial: Trial) -> None:
    """Send random ZeroMQ messages, and random bytes without a handshake."""
    with trial.context.socket(zmq.DEALER) as stranger:
        stranger.setsockopt(zmq.LINGER, 0)
        stranger.connect(f"tcp://127.0.0.1:{trial.port}")
        for _ in range(GARBAGE):
            frames = [trial.dice.randbytes(trial.dice.randrange(300)) for _ in range(3)]
            stranger.send_multipart(frames)
    with socket.create_connection(("127.0.0.1", trial.port)) as raw:
        raw.sendall(trial.dice.randbytes(4096))


EVALUATOR, MASTER = "role=evaluator", "tangram-master"
KINDS: dict[str, Callable[[Trial], None]] = {
    "worker killed": _signal("role=player", signal.SIGKILL),
    "worker asked to end": _signal("role=player", signal.SIGTERM),
    "worker frozen": _freeze("role=player"),
    "evaluator killed": _signal(EVALUATOR, signal.SIGKILL),
    "master killed": _signal(MASTER, signal.SIGKILL),
    "master frozen": _freeze(MASTER),
    "network cut": _cut(UP, DOWN),
    "network cut to the master": _cut(UP),
    "network cut from the master": _cut(DOWN),
    "garbage": _garbage,
}


def run_chaos(minutes: float, seed: int, out: Path | None, folder: Path) -> int:
    """Run a training with faults, compare it with an undisturbed training, and report.

    Args:
        minutes: time with faults.
        seed: seed of the faults and of both trainings.
        out: JSON file for the results; None writes none.
        folder: folder for the two runs, without any runs yet.

    Returns:
        0 if the run recovered from every fault, lost or doubled no episode, left no process and had
        no error, else 1.
    """
    disturbed, straight = folder / "disturbed", folder / "straight"
    port = free_port()
    bounds = (f"seed={seed}", *TCP, f"service.port={port}", "max_updates=0", *SETTINGS)
    launcher = start_training(disturbed, *bounds)
    wait_for(disturbed / "connection.json", launcher)
    setup = make_setup(yaml.safe_load((disturbed / "config.yaml").read_text()))
    with Proxy(port) as proxy:
        witness = Witness(f"tcp://127.0.0.1:{proxy.port}", setup)
        witness.start()
        trial = Trial(disturbed, launcher, proxy, port, random.Random(seed))
        _rage(trial, minutes * 60.0)
        witness.stop()
        witness.join(PATIENCE_S)
        launcher.terminate()
        status = launcher.wait(PATIENCE_S)
    left = len(trial.pids(""))
    delivery = compare(disturbed, witness)
    result = result_of(disturbed)
    start_training(straight, f"seed={seed}", f"max_updates={result['updates']}", *SETTINGS).wait()
    unhealed = sum(took == float("inf") for times in trial.faults.values() for took in times)
    rows = [_row(kind, times) for kind, times in sorted(trial.faults.items())]
    show("faults, and seconds until the run had recovered", rows)
    outcome = {
        "faults": sum(map(len, trial.faults.values())),
        "not_recovered_from": unhealed,
        **delivery,
        "witness_error": str(witness.error or ""),
        "launcher_status": status,
        "processes_left": left,
        "updates": result["updates"],
        "reward": result["mean_reward"],
        "reward_undisturbed": result_of(straight)["mean_reward"],
    }
    show("outcome", [{"what": name, "value": value} for name, value in outcome.items()])
    write(out, {"kinds": rows, "outcome": outcome, "minutes": minutes, "seed": seed})
    bad = ("not_recovered_from", "lost", "doubled", "witness_error", "launcher_status")
    return int(any(outcome[name] for name in (*bad, "processes_left")))


def _rage(trial: Trial, seconds: float) -> None:
    """Cause faults until the time is over, every kind equally often, in random order."""
    until, bag = time.monotonic() + seconds, list[str]()
    while time.monotonic() < until and trial.launcher.poll() is None:
        if not bag:
            bag = trial.dice.sample(list(KINDS), k=len(KINDS))
        kind = bag.pop()
        trial.strike(kind)
        left = until - time.monotonic()
        print(
            f"{left:5.0f} s left: {kind}, recovered after {trial.faults[kind][-1]:.1f} s",
            flush=True,
        )
        time.sleep(trial.dice.uniform(*PAUSE_S))


def _row(kind: str, times: list[float]) -> dict[str, Any]:
    known = [t for t in times if t < float("inf")]
    return {
        "kind": kind,
        "times": len(times),
        "recovered": len(known),
        "median": statistics.median(known) if known else float("nan"),
        "most": max(known, default=float("nan")),
    }
