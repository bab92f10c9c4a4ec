"""The main loop of the master: receive episodes, train, publish weights, save."""

import logging
import time
from dataclasses import dataclass, field

from master.checkpointer import Checkpointer
from master.hub.fair import FairQueue
from master.hub.hub import Hub
from master.learn.budget import Budget
from master.learn.divergence import DivergenceGuard
from master.learn.lockstep import Lockstep
from master.record.delivery import EpisodesArrived
from master.record.rundir import Clock, FolderError, RunFolder
from master.signals import StopSignals, stop_notice
from master.watch.report import Reporter
from tangram_core.errors import FailedError
from tangram_core.run.process import Every, Watchdog
from tangram_core.run.service import ServiceConfig
from tangram_core.wire.messages import RunStatus

# Longest time to learn, to insert or to be idle before the sockets are served again.
LEARN_S = 0.05
INSERT_S = 0.02
IDLE_S = 0.05
# At the end: longest wait for the final scores, for them after a signal, and for workers to leave.
SCORES_S = 120.0
SIGNALLED_SCORES_S = 8.0
LEAVE_S = 5.0

log = logging.getLogger(__name__)


@dataclass(eq=False)
class Loop:
    """Receives episodes, trains, publishes weights and saves until a bound or a signal.

    The arguments must be open already. The loop deletes the folder's connection file at its end.
    The watchdog ends the process if the loop hangs.
    """

    service: ServiceConfig
    folder: RunFolder
    hub: Hub
    guard: DivergenceGuard
    lockstep: Lockstep | None
    budget: Budget
    clock: Clock
    checkpointer: Checkpointer
    reporter: Reporter
    signals: StopSignals
    watchdog: Watchdog
    _arrived: FairQueue[EpisodesArrived] = field(default_factory=FairQueue, init=False)
    _published: int = field(default=-1, init=False)
    _dismissed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._trainer, self._limiter = self.guard.trainer, self.guard.trainer.rate_limiter
        self._publish = Every(self.service.publish_seconds)

    def run(self) -> str:
        """Learn until a bound or a signal ends the loop; returns the reason, as in `over`."""
        self.publish()
        more = False
        while (reason := self.over()) is None:
            self.receive(0.0 if more or self.may_learn() else IDLE_S)
            self.clock.advance(training=self._trainer.episodes > 0)
            if self.lockstep is None:
                more = self.insert()
            else:
                self.insert_round(self.lockstep)
            self.learn()
            self.publish_due()
            self.checkpointer.tick()
            self.reporter.tick(len(self._arrived))
        return reason

    def over(self) -> str | None:
        """The bound or signal that ends the loop now, or None."""
        reason = self.signals.reason or self.budget.spent()
        # After the last episode, the updates that are still due come first.
        if reason is None and not self.budget.takes_episodes() and not self._limiter.may_update():
            return f"max_episodes={self.budget.max_episodes}"
        return reason

    def receive(self, patience_s: float) -> None:
        """Receive batches and scores, and answer the peers; wait at most `patience_s`."""
        self.watchdog.progress()
        for arrival in self.hub.poll(patience_s):
            if isinstance(arrival, EpisodesArrived):
                self._arrived.put(arrival.owner, arrival)
            else:
                self.reporter.scored(arrival)
        record = self.clock.record
        record.workers = max(record.workers, self.hub.count("player"))

    def insert(self) -> bool:
        """Insert batches into the replay buffer while the learner keeps up; the others wait.

        The keys take turns, so that each key has an equal share of the inserted transitions.

        Returns:
            Whether more batches may be inserted at once.
        """
        until_s = time.monotonic() + INSERT_S
        while len(self._arrived) and self._limiter.may_insert() and self.budget.takes_episodes():
            arrival = self._arrived.first()
            if self.hub.discards(arrival):
                self._arrived.serve(0.0)
                continue
            if not self.checkpointer.keep(arrival):
                return False
            self._insert(self._arrived.serve(arrival.episodes.transitions))
            if time.monotonic() >= until_s:
                return True
        return False

    def insert_round(self, lockstep: Lockstep) -> None:
        """In lockstep: insert a round when it is complete; order the next after its updates."""
        while len(self._arrived):
            self._arrived.first()
            lockstep.take(self._arrived.serve(0.0))
        if self.may_learn():
            return
        if not lockstep.ordered:
            self.publish()
            self.hub.order(lockstep.orders(self._published, self._trainer.episodes))
            lockstep.ordered = True
        while (arrival := lockstep.next(self._trainer.episodes)) is not None:
            if not self.checkpointer.keep(arrival):
                return
            self._insert(arrival)
            lockstep.inserted(arrival)

    def may_learn(self) -> bool:
        """Whether an update is due; in lockstep, also whether the round is complete."""
        lockstep = self.lockstep
        whole = lockstep is None or lockstep.begins_round(self._trainer.episodes)
        return whole and self._limiter.may_update()

    def learn(self) -> None:
        """Make the updates that are due, for a short time, so that the sockets are served."""
        until_s = time.monotonic() + LEARN_S
        while self.may_learn() and time.monotonic() < until_s and self.budget.spent() is None:
            self.reporter.updated(self.guard.update(self.budget.share))
            self.publish_due()

    def publish_due(self) -> None:
        """Publish the weights if they are due; in lockstep `insert_round` does so instead."""
        if self.lockstep is None and self._publish.due():
            self.publish()

    def publish(self) -> None:
        """Broadcast the acting weights if they are new; RunError as in `guard.weights`."""
        if self._trainer.updates <= self._published:
            return
        weights = self.guard.weights()
        if weights.version <= self._published:
            return  # the newest weights were not finite; the older ones were sent before
        self.hub.publish(weights)
        self._published = weights.version
        self.reporter.published(weights.version)
        if self.service.publish_seconds > 0.0:  # 0 means after every update, at any cost
            self._publish.rest(self.hub.broadcast_s)

    def finish(self, launched: bool) -> RunStatus:
        """Publish and save the final weights, wait for their scores, and draw the test episodes.

        Args:
            launched: tangram-train started this process, so an evaluator will join.

        Returns:
            The status of the run at its end.

        Raises:
            FailedError: the run folder is gone, or the weights are not finite.
            RunError: the disk is full.
        """
        if self.signals.reason is not None and not launched:  # else tangram-train has shown it
            log.info(stop_notice(self.signals.reason))
        self.guard.check()
        self.publish()
        # First of all, because the rest takes time.
        try:
            self.checkpointer.save()
        except FolderError as error:
            raise FailedError(
                f"{error}: the run ended without a checkpoint, and all since the last one is lost; "
                "if you have a copy of the folder, go on from there with resume=auto"
            ) from None
        self._wait_for_scores(launched)
        self.reporter.draw()
        return self.reporter.flush(len(self._arrived))

    def dismiss(self, reason: str) -> None:
        """Tell all peers to end, and wait up to `LEAVE_S` for them to leave."""
        self._dismissed = True
        # First: while this file exists, new workers join and tangram-train restarts the old ones.
        self.folder.remove_connection()
        until_s = time.monotonic() + LEAVE_S
        self.hub.stop(reason)
        while self.hub.peers and time.monotonic() < until_s:
            self.hub.poll(IDLE_S)

    def close(self) -> None:
        """Dismiss all peers if that was not done, which means that the master failed."""
        if not self._dismissed:
            self.dismiss("the master failed")

    def _insert(self, arrival: EpisodesArrived) -> None:
        self._trainer.insert(arrival.episodes)
        # Only now, because a worker deletes a batch that is acknowledged.
        self.hub.acknowledge(arrival)
        self.reporter.inserted(arrival)

    def _wait_for_scores(self, launched: bool) -> None:
        """Wait for scores, for a limited time, if there is an evaluator or one may still join."""
        record, signalled = self.clock.record, self.signals.reason is not None
        limit_s = SIGNALLED_SCORES_S if signalled else SCORES_S + self.service.eval_seconds
        begun_s = time.monotonic()
        told = False
        while record.scored_version != self._trainer.updates:
            waited_s = time.monotonic() - begun_s
            hurried = self.signals.reason is not None and not signalled
            # An evaluator of tangram-train may still be loading: a minute on a busy machine.
            hopeless = (signalled or not launched) and not self.hub.count("evaluator")
            if waited_s >= limit_s or hurried or hopeless:
                return
            if not told:
                log.info("waiting for the scores of the final weights")
                told = True
            self.receive(IDLE_S)
            self.reporter.tick(len(self._arrived))
