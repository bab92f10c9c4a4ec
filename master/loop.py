"""The master: one process, one loop, from what workers played to the weights they play with."""

import time
from collections import deque
from queue import SimpleQueue

from master.arrivals import EpisodesArrived, ScoresArrived
from master.checkpointer import Checkpointer
from master.lockstep import Lockstep
from master.parts import Parts
from master.report import Reporter, scores_picture
from master.rundir import Clock
from master.signals import StopSignals
from tangram_agent.messages import Scores
from tangram_agent.process import Every, Watchdog

# Between two looks at the sockets: learning goes on for so long, or idleness lasts.
LEARN_S = 0.05
IDLE_S = 0.05
# At the end: for the scores of the final weights, the same after a signal, and for goodbyes.
SCORES_S = 60.0
SIGNALLED_SCORES_S = 8.0
JOIN_S = 30.0  # for an evaluator that has not joined yet, or was given up
LEAVE_S = 5.0
PICTURE_PIXELS = 240


class Loop:
    """Moves the parts until a bound or a signal ends it; `news` are a launcher's lines.

    Attributes:
        parts: of the run.
        clock: adds up its time.
    """

    def __init__(
        self,
        parts: Parts,
        reporter: Reporter,
        signals: StopSignals,
        news: "SimpleQueue[str]",
        watchdog: Watchdog,
    ) -> None:
        service = parts.config.service
        self.parts, self.clock = parts, Clock(parts.record)
        self._reporter, self._signals, self._news = reporter, signals, news
        self._watchdog = watchdog
        self._arrived: deque[EpisodesArrived] = deque()
        self._latest: Scores | None = None
        self._published, self._dismissed = -1, False
        self._stage = -1
        self._publish = Every(service.publish_seconds)
        self._checkpointer = Checkpointer(
            service,
            parts.folder,
            parts.guard,
            parts.hub,
            parts.journal,
            self.clock,
            reporter.progress.notice,
        )

    def run(self) -> str:
        """Learn until a bound or a signal ends it; returns which."""
        parts = self.parts
        self.publish()
        parts.folder.write_connection(parts.connection())
        while (reason := self.over()) is None:
            self.receive(0.0 if self.may_learn() else IDLE_S)
            self.clock.advance(training=self.parts.trainer.episodes > 0)
            if parts.lockstep is None:
                self.insert()
            else:
                self.insert_round(parts.lockstep)
            self.learn()
            if parts.lockstep is None and self._publish.due():
                self.publish()
            self._checkpointer.tick()
            self.tell()
        return reason

    def over(self) -> str | None:
        """Why the loop ends now, or None."""
        if self._signals.reason is not None:
            return self._signals.reason
        parts, trainer = self.parts, self.parts.trainer
        reason = parts.budget.spent(parts.record.loop_s, trainer.updates)
        if reason is None and not parts.budget.takes_episodes(trainer.episodes):
            # The updates that these episodes are worth come first.
            due = trainer.rate_limiter.may_update()
            return None if due else f"max_episodes={parts.budget.max_episodes}"
        return reason

    def receive(self, patience_s: float) -> None:
        """Take what has arrived, and answer the peers."""
        self._watchdog.progress()
        parts = self.parts
        for arrival in parts.hub.poll(patience_s):
            if isinstance(arrival, ScoresArrived):
                self._latest = arrival.scores
                parts.record.score(arrival.scores.scalars, arrival.scores.weights_version)
                self._reporter.scored(arrival.scores, parts)
            else:
                self._arrived.append(arrival)
        parts.record.workers = max(parts.record.workers, parts.count("player"))

    def insert(self) -> None:
        """Move batches into the replay while the learner keeps up; senders of others wait."""
        trainer, budget = self.parts.trainer, self.parts.budget
        limiter = trainer.rate_limiter
        while self._arrived and limiter.may_insert() and budget.takes_episodes(trainer.episodes):
            if not self._checkpointer.keep(self._arrived[0]):
                return
            self._insert(self._arrived.popleft())

    def insert_round(self, lockstep: Lockstep) -> None:
        """In lockstep: insert a round when it is whole, order the next when it is learned."""
        trainer = self.parts.trainer
        while self._arrived:
            lockstep.take(self._arrived.popleft())
        if self.may_learn():
            return
        if not lockstep.ordered:
            self.publish()
            self.parts.hub.order(lockstep.orders(self._published, trainer.episodes))
            lockstep.ordered = True
        while (arrival := lockstep.next(trainer.episodes)) is not None:
            if not self._checkpointer.keep(arrival):
                return
            self._insert(arrival)
            lockstep.inserted(arrival)

    def _insert(self, arrival: EpisodesArrived) -> None:
        trainer = self.parts.trainer
        trainer.insert(arrival.episodes)
        # Only now: a worker forgets what is acknowledged.
        self.parts.hub.acknowledge(arrival)
        self._reporter.inserted(arrival, trainer.updates)

    def may_learn(self) -> bool:
        """Whether an update is due, and in lockstep whether the round is whole."""
        lockstep, trainer = self.parts.lockstep, self.parts.trainer
        whole = lockstep is None or lockstep.begins_round(trainer.episodes)
        return whole and trainer.rate_limiter.may_update()

    def learn(self) -> None:
        """Updates that are due, for a short while, so that the sockets are served in between."""
        parts, trainer = self.parts, self.parts.trainer
        until_s = time.monotonic() + LEARN_S
        while self.may_learn() and time.monotonic() < until_s:
            if parts.budget.spent(parts.record.loop_s, trainer.updates):
                return
            self._reporter.updated(parts.guard.update(parts.share))
            if parts.config.service.every_update:
                self.publish()

    def publish(self) -> None:
        """Send the acting weights, unless these were sent before.

        Raises:
            RunError: they are not finite, one time too many; nothing was sent.
        """
        if self.parts.trainer.updates <= self._published:
            return
        weights = self.parts.guard.weights()
        if weights.version <= self._published:
            return  # the present ones were bad, and the last good ones are known
        self.parts.hub.publish(weights)
        self._tell_stage(weights.version)
        self._published = weights.version
        self._reporter.published(weights.version, self.parts)

    def _tell_stage(self, updates: int) -> None:
        """Say when the curriculum goes on: workers play by the weights that they get."""
        sim = self.parts.setup.sim
        stage = sim.stage(updates)
        if sim.stages and stage != self._stage:
            self._reporter.progress.notice(f"{sim.told(stage)}, from update {updates:,} on")
        self._stage = stage

    def tell(self) -> None:
        """Show where the run stands."""
        while not self._news.empty():
            self._reporter.progress.notice(self._news.get(), event="launcher")
        more = {"queue": len(self._arrived), **self._checkpointer.numbers()}
        self._reporter.tick(self.parts, more)

    def finish(self, launched: bool) -> None:
        """Send and keep the final weights, have them scored, draw the test episodes.

        Args:
            launched: an evaluator is known to come, even if it has not joined yet.

        Raises:
            RunError: the disk is full.
        """
        self.parts.guard.check()
        self.publish()
        # Before anything that takes time: what was learned is safe from here on.
        self._checkpointer.save()
        self._wait_for_scores(launched)
        self.tell()
        self._reporter.flush(self.parts)
        if self._latest is not None and len(self._latest.ends):
            picture = scores_picture(self._latest, self.parts.setup, PICTURE_PIXELS)
            picture.save(self.parts.folder.picture)

    def dismiss(self, reason: str) -> None:
        """Send all peers home and wait a moment for them to leave."""
        self._dismissed = True
        # First: it would bring new ones, and a launcher restarts who ends while it is there.
        self.parts.folder.connection.unlink(missing_ok=True)
        hub, until_s = self.parts.hub, time.monotonic() + LEAVE_S
        hub.stop(reason)
        while hub.peers and time.monotonic() < until_s:
            hub.poll(IDLE_S)

    def close(self) -> None:
        """Let nobody wait for a master that failed."""
        if not self._dismissed:
            self.dismiss("the master failed")

    def _wait_for_scores(self, launched: bool) -> None:
        """Bounded, and not where nobody could score the weights."""
        parts, signalled = self.parts, self._signals.reason is not None
        limit_s = SCORES_S + parts.config.service.eval_seconds
        until_s = time.monotonic() + (SIGNALLED_SCORES_S if signalled else limit_s)
        join_s = time.monotonic() + JOIN_S
        told = False
        while parts.record.scored_version != parts.trainer.updates and time.monotonic() < until_s:
            hurried = self._signals.reason is not None and not signalled
            late = signalled or not launched or time.monotonic() >= join_s
            hopeless = late and not parts.count("evaluator")
            if hurried or hopeless:
                return
            if not told:
                self._reporter.progress.notice("waiting for the scores of the final weights")
                told = True
            self.receive(IDLE_S)
            self.tell()
