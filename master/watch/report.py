"""The status of a run: collected in one place, and passed at bounded rates to all outputs."""

import json
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from master.checkpointer import Checkpointer
from master.hub.hub import Hub
from master.hub.registry import Peer
from master.learn.budget import Budget, Rates
from master.learn.divergence import DivergenceGuard
from master.learn.trainer import Trainer
from master.record.delivery import REMEMBERED_VERSIONS, EpisodesArrived
from master.record.rundir import Clock, Record
from master.watch.console import PLAYED, TEST, Progress
from master.watch.metrics import Means, Metrics, Thinning
from tangram_core.arrays import Floats
from tangram_core.errors import RunError
from tangram_core.run.process import Every
from tangram_core.scores import SHOWN, written
from tangram_core.store.files import write_whole
from tangram_core.wire.messages import WORKER_COLUMNS, RunStatus, Scores

UNKNOWN = -1.0
PICTURE_S = 30.0
PICTURES = 100  # in TensorBoard; see POINTS in `metrics`
TICK_S = 0.1
LISTEN_S = 1.0
LOG_S = 2.0  # between two points of the curves


class StatusCollector:
    """Collects the status of a run; all outputs show numbers of this status.

    Attributes:
        played: mean reward of recent episodes, by its name.
    """

    def __init__(
        self,
        name: str,
        guard: DivergenceGuard,
        hub: Hub,
        budget: Budget,
        clock: Clock,
        checkpointer: Checkpointer,
    ) -> None:
        self._name, self._guard, self._hub, self._budget = name, guard, hub, budget
        self._clock, self._checkpointer = clock, checkpointer
        self._rates = Rates()
        self.played: dict[str, float] = {}

    def mark(self) -> None:
        """Note the counters, to compute rates; call this a few times per second."""
        trainer, share = self._guard.trainer, self._budget.share
        now_s, busy_s = time.monotonic(), time.thread_time()
        self._rates.mark(now_s, trainer.transitions, trainer.updates, share, busy_s)

    def collect(self, queue: int, each: bool = True) -> RunStatus:
        """The present status.

        Args:
            queue: number of batches that wait for their insert.
            each: include a row for each worker, which takes milliseconds if there are many.
        """
        trainer, record, rates = self._guard.trainer, self._clock.read(), self._rates
        players, left_s = self._hub.count("player"), rates.left_s()
        bounded = self._budget.bounded
        numbers = {
            "episodes": trainer.episodes,
            "transitions": trainer.transitions,
            "updates": trainer.updates,
            "elapsed_s": record.loop_s,
            "train_s": record.train_s,
            "wall_s": record.wall_s,
            "share": self._budget.share if bounded else UNKNOWN,
            "left_s": left_s if bounded and left_s is not None else UNKNOWN,
            "transitions_per_s": rates.transitions_per_s(),
            "updates_per_s": rates.updates_per_s(),
            "players": players,
            "most_players": record.workers,
            "evaluators": self._hub.count("evaluator"),
            "lag_updates": trainer.rate_limiter.lag,
            "broadcast_s": self._hub.broadcast_s,
            "replay": trainer.learner.kept,
            "replay_capacity": trainer.learner.capacity,
            "undone_updates": self._guard.undone,
            "queue": queue,
            "checkpoint_age_s": self._checkpointer.age_s,
            "disk_failing": self._checkpointer.failing,
            "open_to_all": self._hub.open_to_all,
            "scored_updates": record.scored_version,
            **{TEST + name: value for name, value in record.scores.items()},
            **self.played,
            **(self._balance() if each else {}),
            # These come last, because numbers beyond the limit of a status are left out.
            **{f"hub/{name}": count for name, count in sorted(self._hub.counters.items())},
        }
        texts = {
            "run": self._name,
            "run_id": record.run_id,
            "scores": json.dumps(written(trainer.setup.task.scores[:SHOWN])),
            "activity": HOMELESS if self._checkpointer.homeless else activity(trainer, players),
        }
        return RunStatus(numbers, texts, _workers(self._hub.peers if each else (), trainer.updates))

    def _balance(self) -> dict[str, float]:
        """Transitions per second that players and learner could reach if they never waited."""
        trainer = self._guard.trainer
        return {
            "could_play": could_play(self._hub.peers, trainer.setup.spec.horizon),
            "could_learn": self._rates.transitions_per_busy_s() if trainer.updates else 0.0,
        }


HOMELESS = "waiting for the run folder, which is gone or was replaced"


def activity(trainer: Trainer, players: int) -> str:
    """The present activity as text, such as `learning` or `waiting for episodes`."""
    limiter, starts = trainer.rate_limiter, trainer.pace.learning_starts
    if limiter.may_update():
        faster = players and not limiter.may_insert()
        return "learning, faster workers wait" if faster else "learning"
    if not players:
        return "waiting for workers to join"
    if trainer.episodes and not limiter.transitions:
        return f"waiting for an episode to learn from: {trainer.setup.task.waits}"
    if limiter.transitions < starts:
        return f"filling the replay, {limiter.transitions:,} of {starts:,}"
    return "waiting for episodes"


def could_play(peers: Iterable[Peer], horizon: int) -> float:
    """Transitions per second of all players if each had a core and never waited; 0 if unknown."""
    told = [peer.stats for peer in peers if peer.role == "player"]
    found = [(one.get("episodes", 0.0), one.get("busy_s", 0.0)) for one in told]
    rates = [episodes / seconds for episodes, seconds in found if seconds > 0.0]
    return horizon * sum(rates) * len(told) / max(len(rates), 1)


def _workers(peers: Sequence[Peer], updates: int) -> Floats:
    rows = [_row(peer, time.monotonic(), updates) for peer in peers]
    return np.array(rows, np.float64).reshape(-1, len(WORKER_COLUMNS))


def _row(peer: Peer, now_s: float, updates: int) -> list[float]:
    played = peer.weights_version
    return [
        peer.role == "evaluator",
        peer.index,
        peer.incarnation,
        max(0.0, now_s - peer.last_seen),
        UNKNOWN if played < 0 else max(0, updates - played),
        peer.batches,
        peer.episodes,
        peer.transitions,
        len(peer.ledger.held),
    ]


@dataclass(frozen=True)
class Sent:
    """Monotonic time, inserted episodes and seconds of training when weights were broadcast."""

    at_s: float
    episodes: int
    train_s: float


class Reporter:
    """Collects events of the loop and reports them to console, curves and listeners.

    Listeners get the status about once per second; `picture` is the file for the test episodes.
    """

    def __init__(
        self,
        trainer: Trainer,
        record: Record,
        status: StatusCollector,
        progress: Progress,
        metrics: Metrics,
        listeners: Sequence[Callable[[RunStatus], None]],
        picture: Path,
    ) -> None:
        self._trainer, self._record, self._status = trainer, record, status
        self._progress, self.metrics, self._listeners = progress, metrics, listeners
        self._losses, self._play = Means(), Means()
        self._tick, self._listen = Every(TICK_S, at_once=True), Every(LISTEN_S, at_once=True)
        self._log, self._picture = Every(LOG_S), Every(PICTURE_S, at_once=True)
        self._point, self._shown = Thinning(record.loop_s), Thinning(record.loop_s, PICTURES)
        self._path = picture
        self._published: OrderedDict[int, Sent] = OrderedDict()
        self._latest: Scores | None = None

    def published(self, version: int) -> None:
        """Note when a version of the weights was broadcast, after how many episodes."""
        self._published.setdefault(version, self._now())
        while len(self._published) > REMEMBERED_VERSIONS:
            self._published.popitem(last=False)

    def updated(self, losses: Mapping[str, float]) -> None:
        """Note the losses of one update."""
        self._losses.add(losses)

    def inserted(self, arrival: EpisodesArrived) -> None:
        """Note a batch that was inserted into the replay buffer."""
        episodes = arrival.episodes
        values = {
            PLAYED: float(np.mean(episodes.rewards[:, -1])),
            "weights/age_updates": float(self._trainer.updates - arrival.weights_version),
        }
        sent = self._published.get(arrival.weights_version)
        if sent is not None:
            values["weights/age_seconds"] = time.monotonic() - sent.at_s
        self._play.add(values, episodes.count)

    def scored(self, scores: Scores) -> None:
        """Add an evaluation of earlier weights to the record, the curves and the picture."""
        if self._record.scored_version != self._trainer.updates:  # a slower evaluator's stay out
            self._record.score(scores.scalars, scores.weights_version)
            self._latest = scores
        values = {name: value for name, value in scores.scalars.items() if name != "episodes"}
        updates = scores.weights_version
        sent = self._published.get(updates, self._now())
        self.metrics.scores(values, updates, sent.episodes, sent.train_s)
        # At intervals, since drawing takes time from learning.
        if len(scores.picture) and self._picture.due():
            if self._shown.due():
                half = Image.fromarray(scores.picture).reduce(2)
                self.metrics.picture(np.asarray(half), updates)
            with suppress(RunError):  # the journal reports a disk that fails
                self.draw()

    def tick(self, queue: int) -> None:
        """Report the status and write the curves if they are due; `queue` as in `collect`."""
        if not self._tick.due():
            return
        self._status.mark()
        if self._log.due():
            self.flush(queue)
            return
        listened = self._listen.due()
        status = self._status.collect(queue, each=listened)
        self._progress.show(status)
        if listened:
            for listen in self._listeners:
                listen(status)

    def flush(self, queue: int) -> RunStatus:
        """Report the status at once, and return it; write a point of the curves if it is due."""
        played = self._play.take()
        if PLAYED in played:
            self._status.played = {PLAYED: played[PLAYED]}
        status = self._status.collect(queue)
        self._progress.show(status)
        for listen in self._listeners:
            listen(status)
        if not self._point.due():
            return status
        values = {f"train/{name}": value for name, value in self._losses.take().items()}
        values |= played
        for name, value in status.numbers.items():
            if not name.startswith((TEST, PLAYED)):  # these are written elsewhere
                values[name if "/" in name else f"run/{name}"] = value
        self.metrics.scalars(values, self._trainer.updates)
        return status

    def draw(self) -> None:
        """Write the picture of the last evaluation, if there is one; RunError if the disk fails."""
        if self._latest is not None and len(self._latest.picture):
            drawn = BytesIO()
            Image.fromarray(self._latest.picture).save(drawn, "PNG")
            write_whole(self._path, drawn.getvalue(), above=False)

    def _now(self) -> Sent:
        return Sent(time.monotonic(), self._trainer.episodes, self._record.train_s)
