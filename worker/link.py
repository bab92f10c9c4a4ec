"""A worker's end of the conversation with the master: batches out, weights in.

Nothing here waits without looking at `stopped` every STEP_S, so a signal handler that calls `stop`
ends each wait.
"""

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Self

from tangram_agent.arrays import EpisodeSpec, WeightShapes
from tangram_agent.messages import EpisodeBatch, Go, Scores, Welcome
from tangram_agent.types import Episodes, Weights
from tangram_sim.errors import TangramError
from worker.connection import missing
from worker.talk import Talk
from worker.terms import Introduction, Timing

STEP_S = 0.1
# Between two log lines of what is waited for.
TELL_S = 60.0

log = logging.getLogger(__name__)


class Link:
    """One process's end; made without any I/O, `join` starts it.

    Args:
        connect: tcp://host:port, a connection file, or a run folder that holds one.
        role: player or evaluator.
        index: wanted within the role, -1 for any.
        fingerprints: section of the settings -> digest, which the master compares.
        spec: the task that arrays are checked against.
        shapes: of the tensors that weights must have; None takes any.
        window: most batches kept unacknowledged; the master's own bound holds as well.
        timing: patience.

    Attributes:
        on_progress: called whenever the link is at work.
    """

    def __init__(
        self,
        connect: str,
        role: str,
        index: int,
        fingerprints: Mapping[str, str],
        spec: EpisodeSpec,
        shapes: WeightShapes | None = None,
        window: int = 4,
        timing: Timing | None = None,
    ) -> None:
        self._spec, self._timing = spec, timing or Timing()
        self.on_progress: Callable[[], None] = lambda: None
        who = Introduction(connect, role, index, fingerprints)
        self._talk = Talk(who, window, shapes, self._timing)
        self._stop_reason = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def welcome(self) -> Welcome:
        """The master's last WELCOME: seed, run_id, index, incarnation.

        Raises:
            TangramError: before `join`.
        """
        if self._talk.welcome is None:
            raise TangramError("the link has not joined a master yet: call join() first")
        return self._talk.welcome

    @property
    def stats(self) -> dict[str, float]:
        """Numbers that the next heartbeats tell the master, to be set."""
        return self._talk.stats

    @property
    def counters(self) -> Counter[str]:
        """What was sent again, refused, lost or not understood."""
        return self._talk.counters

    @property
    def acknowledged(self) -> int:
        """Number of the last batch up to which all were acknowledged."""
        return self._talk.spool.first - 1

    @property
    def stopped(self) -> bool:
        """Whether this process must end."""
        return bool(self._stop_reason) or self._talk.dismissed

    @property
    def stop_reason(self) -> str:
        """Why it must end, empty while it need not."""
        return self._stop_reason or self._talk.reason

    @property
    def window_free(self) -> int:
        """Batches that can be sent without waiting."""
        return self._talk.spool.free

    def stop(self, reason: str) -> None:
        """Ask all waits to end; safe in a signal handler."""
        self._stop_reason = self._stop_reason or reason or "stopped"

    def join(self) -> bool:
        """Wait for the master and its WELCOME; False if `stop` was called meanwhile.

        Raises:
            TangramError: no master in time, or it refused; the reason is the master's.
        """
        joined = self._wait(lambda: self._talk.joined, "the master", self._timing.join_s)
        if not joined and not self.stopped:
            line = self._talk.line
            if line.stranger:
                raise TangramError(line.estranged)
            if not line.found:
                raise TangramError(missing(line.place, self._timing.join_s))
            raise TangramError(
                f"no master answers at {line.place} after {self._timing.join_s:g} s: "
                "is tangram-master running there?"
            )
        return joined

    def poll(self, timeout_s: float = 0.0) -> None:
        """Take what came, send what is due; waits at most so long for something to come.

        Raises:
            TangramError: the master refuses this process, or did not answer for `lost_s`.
        """
        self.on_progress()
        self._talk.step(timeout_s)

    def send(self, episodes: Episodes, weights_version: int) -> bool:
        """Send a batch when the window has room; False, and it is not sent, if stopped before.

        Raises:
            WireError: the batch breaks the task's bounds; names the field.
        """
        if not self.wait_for_window():
            return False
        batch = EpisodeBatch(self._talk.spool.next, weights_version, episodes)
        self._talk.post_next(batch.encode(self._spec))
        self.poll()
        return True

    def wait_for_window(self) -> bool:
        """Wait until a batch may be sent; False if stopped."""
        return self._wait(lambda: self._talk.spool.free > 0, "the master to take what was played")

    def send_scores(self, scores: Scores) -> None:
        """Send the results of an evaluation, once; they are lost if no master is there.

        Raises:
            WireError: content that the master would refuse.
        """
        if not self._talk.post(scores.encode(self._spec)):
            self.counters["lost_scores"] += 1

    def newest_weights(self) -> Weights | None:
        """The newest weights that came, None if they were returned before."""
        return self._talk.inbox.take()

    def wait_for_weights(self) -> Weights | None:
        """Wait for newer weights; None if stopped."""
        found: list[Weights] = []

        def take() -> bool:
            weights = self.newest_weights()
            found.extend([] if weights is None else [weights])
            return bool(found)

        self._wait(take, "newer weights")
        return found[0] if found else None

    def wait_for_order(self, done: Go | None) -> Go | None:
        """In lockstep: wait for what to play after an order that was done; None if stopped."""

        def is_new() -> bool:
            order = self._talk.order
            return order is not None and (done is None or order.number != done.number)

        return self._talk.order if self._wait(is_new, "its turn") else None

    def drain(self, timeout_s: float) -> bool:
        """Wait until all batches are acknowledged, also after `stop`; False if that failed."""
        deadline = time.monotonic() + timeout_s
        while self._talk.spool and not self._talk.dismissed and time.monotonic() < deadline:
            self.poll(min(STEP_S, timeout_s))
        return not self._talk.spool

    def close(self, reason: str = "") -> None:
        """Say BYE and close; takes a second at most."""
        self._talk.close(reason or self.stop_reason or "done")

    def _wait(self, done: Callable[[], bool], what: str, timeout_s: float = math.inf) -> bool:
        begun = told = time.monotonic()
        while not self.stopped:
            if done():
                return True
            now = time.monotonic()
            if now - begun >= timeout_s:
                return False
            if now - told >= TELL_S:
                told = now
                lacks = self._talk.lacks or what
                log.info("waits for %s since %.0f s", lacks, now - begun, extra={"event": "waits"})
            self.poll(min(STEP_S, timeout_s))
        return False
