"""The worker's side of the protocol: sends batches of episodes, receives weights.

Delivery: all unacknowledged batches are sent again, in order, after each WELCOME (a new connection
or a restarted master), when the master got a batch out of turn, and when no acknowledgement came
for a while. The master drops batches that it already has.

Every wait checks `stopped` at least every STEP_S seconds, so a signal handler that calls `stop`
ends any wait.
"""

import logging
import math
import secrets
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Self

from tangram_core.agent import Weights
from tangram_core.errors import TangramError, UnavailableError, WireError
from tangram_core.spec import Episodes, EpisodeSpec
from tangram_core.wire.addresses import host_of, reachable
from tangram_core.wire.arrays import WeightShapes
from tangram_core.wire.messages import (
    GAP,
    WINDOW,
    Ack,
    Alive,
    Bye,
    EpisodeBatch,
    Go,
    Greet,
    Heartbeat,
    Hello,
    Refused,
    Reject,
    RunStatus,
    Scores,
    Stop,
    ToWorker,
    WantWeights,
    WeightsMessage,
    Welcome,
    decode_from_master,
    decode_weights,
)
from tangram_core.wire.schema import Message, ProtocolError
from worker.talk.connection import Connection, Sockets, Timing
from worker.talk.outbox import NewestWeights, Outbox

STEP_S = 0.1
# Seconds between two log lines about a wait.
TELL_S = 60.0
# Longest wait before all batches are sent again, in units of `Timing.resend_s`.
MOST_PATIENCE = 8.0

log = logging.getLogger(__name__)


class Client:
    """Protocol client of one worker; the constructor does no I/O, `join` connects.

    Args:
        connect: host:port, a connection file, or a run folder that holds one.
        role: player or evaluator.
        index: wanted number within the role; -1 for any.
        fingerprints: section of the settings -> digest, compared by the master.
        spec: shapes that episodes are checked against.
        shapes: required shapes of the weight tensors; None accepts any.
        window: upper bound of unacknowledged batches; the bound of the master applies, too.
        timing: timeouts.

    Attributes:
        stats: numbers that the caller sets and the next heartbeats send to the master.
        counters: counts of messages sent again, refused, lost or malformed.
        joined: whether the master has accepted the present connection.
        on_progress: called at every `poll`.
    """

    def __init__(
        self,
        connect: str,
        role: str,
        index: int,
        fingerprints: Mapping[str, str],
        spec: EpisodeSpec,
        shapes: WeightShapes | None = None,
        window: int = WINDOW,
        timing: Timing | None = None,
    ) -> None:
        self.stats: dict[str, float] = {}
        self.counters: Counter[str] = Counter()
        self.outbox, self.newest = Outbox(window), NewestWeights()
        self.joined = False
        self.on_progress: Callable[[], None] = lambda: None
        self._timing = timing or Timing()
        self._connection = Connection(connect, self._timing, self.counters, role)
        self._role, self._index, self._fingerprints = role, index, fingerprints
        self._spec, self._shapes, self._window = spec, shapes, window
        self._process = secrets.token_hex(16)
        self._welcome: Welcome | None = None
        self._order: Go | None = None
        self._again = False
        self._stop_reason = ""
        # Whether the master has told this process to end, and its reason.
        self._dismissed, self._dismissal = False, ""
        self._hello_at = self._heartbeat_at = self._resend_at = 0.0
        self._patience = 1.0  # doubles with each resend

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def welcome(self) -> Welcome:
        """The master's last WELCOME: seed, run_id, index, incarnation; only after `join`."""
        if self._welcome is None:
            raise TangramError("the client has not joined a master yet: call join() first")
        return self._welcome

    @property
    def acknowledged(self) -> int:
        """The largest n such that batches 1 to n are all acknowledged."""
        return self.outbox.first - 1

    @property
    def stopped(self) -> bool:
        """Whether this process must end."""
        return bool(self._stop_reason) or self._dismissed

    @property
    def stop_reason(self) -> str:
        """Why this process must end; empty if it need not."""
        return self._stop_reason or self._dismissal

    @property
    def window_free(self) -> int:
        """Number of batches that can be sent without waiting."""
        return self.outbox.free

    def stop(self, reason: str) -> None:
        """Make every wait end; safe in a signal handler."""
        self._stop_reason = self._stop_reason or reason or "stopped"

    def join(self) -> bool:
        """Wait for the WELCOME of the master; False if `stop` was called meanwhile.

        Raises:
            TangramError: no master answered in time, or the master refused and gave the reason.
        """
        patience = self._timing.join_s
        log.info(
            "joins %s, waits at most %g s for its master",
            self._connection.place,
            patience,
            extra={"event": "joining"},
        )
        joined = self._wait(lambda: self.joined, "the master", self._timing.join_s)
        if not joined and not self.stopped:
            raise self._connection.no_master(self._timing.join_s)
        return joined

    def poll(self, timeout_s: float = 0.0) -> None:
        """Handle received messages and send what is due; wait at most `timeout_s` for a message.

        Raises:
            TangramError: the master refuses this process, belongs to another run, or has not
                answered for `Timing.lost_s` seconds.
        """
        self.on_progress()
        sockets = self._connection.sockets or self._open()
        if sockets is None:  # the connection file is still missing
            time.sleep(timeout_s)
        else:
            sockets.wait(timeout_s)
            self._connection.watch(time.monotonic())
            self._receive_weights(sockets)
            for frames in sockets.messages():
                self._receive(frames)
            self._do_what_is_due(sockets, time.monotonic())
        self._connection.check_lost(time.monotonic())

    def send(self, episodes: Episodes, weights_version: int) -> bool:
        """Send a batch once the window has room; False if stopped before it was sent.

        Raises:
            WireError: a value is outside the bounds of the task; the message names the field.
        """
        if not self.wait_for_window():
            return False
        frames = EpisodeBatch(self.outbox.next, weights_version, episodes).encode(self._spec)
        if not self.outbox:
            self._be_patient(time.monotonic())
        self.outbox.add(frames)
        self._again = False
        self._post(frames)
        self.poll()
        return True

    def wait_for_window(self) -> bool:
        """Wait until the window has room for a batch; False if stopped."""
        return self._wait(lambda: self.outbox.free > 0, "the master to take what was played")

    def send_scores(self, scores: Scores) -> None:
        """Send the scores of an evaluation once; they are lost if no master is connected."""
        if not self._post(scores.encode(self._spec)):
            self.counters["lost_scores"] += 1

    def newest_weights(self) -> Weights | None:
        """The newest received weights; None if they were already returned."""
        return self.newest.take()

    def wait_for_weights(self) -> Weights | None:
        """Wait for newer weights and return them; None if stopped."""
        waited = self._wait(lambda: self.newest.waits, "newer weights")
        return self.newest.take() if waited else None

    def wait_for_order(self, done: Go | None) -> Go | None:
        """In lockstep: wait for the order that follows `done`; None if stopped.

        The same order is returned again if the batch played for it was refused.
        """

        def is_new() -> bool:
            order = self._order
            return order is not None and (self._again or order != done)

        return self._order if self._wait(is_new, "its turn") else None

    def close(self) -> None:
        """Say BYE and close the connection; takes at most a second, even without a master."""
        if self._connection.sockets is not None:
            self._connection.sockets.send(Bye(self.stop_reason or "done").encode())
        self._connection.close()

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
                lacks = self._connection.lacks(self.joined) or what
                log.info(
                    "waits for %s, %.0f s so far", lacks, now - begun, extra={"event": "waits"}
                )
            self.poll(min(STEP_S, timeout_s))
        return False

    # Sending

    def _open(self) -> Sockets | None:
        if self._connection.open() and self._connection.sockets is not None:
            self._say_hello(self._connection.sockets, time.monotonic())
        return self._connection.sockets

    def _do_what_is_due(self, sockets: Sockets, now: float) -> None:
        if self._connection.is_dead(now, self._welcome is not None):
            self.joined = False
            self._connection.drop()
            self._open()
        elif not self.joined:
            if now >= self._hello_at:
                self._say_hello(sockets, now)
        else:
            if now >= self._heartbeat_at:
                self._heartbeat_at = now + self._timing.heartbeat_s
                self._ask(sockets, Heartbeat(self.stats), now)
            if self.outbox and now >= self._resend_at:
                self._resend(now)

    def _say_hello(self, sockets: Sockets, now: float) -> None:
        known = self._welcome
        file = "" if self._connection.address is None else self._connection.address.run_id
        hello = Hello(
            role=self._role,
            index=self._index if known is None else known.index,
            incarnation=0 if known is None else known.incarnation,
            process=self._process,
            first=self.outbox.first,
            fingerprints=self._fingerprints,
            run_id=file if known is None else known.run_id,
        )
        self._hello_at = now + self._timing.retry_s
        self._ask(sockets, hello, now)

    def _ask(self, sockets: Sockets, question: Message, now: float) -> None:
        self._connection.asked(now)
        sockets.send(question.encode())

    def _post(self, frames: list[bytes]) -> bool:
        """Send if joined and if the socket has room; otherwise False."""
        sockets = self._connection.sockets
        return self.joined and sockets is not None and sockets.send(frames)

    def _resend(self, now: float) -> None:
        """Send all batches again, and double the wait until the next time.

        A master that is only slow already has the batches. Batches that were really lost are sent
        again at once after a WELCOME, and soon after a REJECT.
        """
        self._patience = min(2.0 * self._patience, MOST_PATIENCE)
        self._resend_at = now + self._patience * self._timing.resend_s
        self._post_all()

    def _post_all(self) -> None:
        for frames in self.outbox.messages:
            self.counters["resent"] += 1
            self._post(frames)

    def _be_patient(self, now: float) -> None:
        """Restart the resend timer with its shortest wait."""
        self._patience = 1.0
        self._resend_at = now + self._timing.resend_s

    def _want_weights(self) -> None:
        self._post(WantWeights(self.newest.epoch, self.newest.version).encode())

    # Receiving

    def _receive(self, frames: list[bytes]) -> None:
        try:
            message = decode_from_master(frames, self._shapes)
        except ProtocolError:
            raise
        except WireError as error:
            self.counters["malformed"] += 1
            self._warn("malformed", "a message of the master at %s cannot be decoded: %s", error)
            return
        self._connection.answered()
        if not isinstance(message, RunStatus):  # a worker never asks for a status
            self._handle(message, time.monotonic())

    def _receive_weights(self, sockets: Sockets) -> None:
        frame = sockets.weights()
        if frame is None:
            return
        try:
            self.newest.offer(*decode_weights(frame, self._shapes))
        except WireError as error:
            self.counters["malformed"] += 1
            self._warn("bad_weights", "weights from %s are refused: %s", error)

    def _handle(self, message: ToWorker, now: float) -> None:
        match message:
            case Ack(sequence):
                if self.outbox.remove(sequence):
                    self._be_patient(now)
            case Reject():
                self._take_back(message, now)
            case Go():
                self._order = message
            case Alive(version):
                if self.newest.version < version:  # the broadcast was missed or is still coming
                    self._want_weights()
            case WeightsMessage(epoch, weights):
                self.newest.offer(epoch, weights)
            case _:
                self._handle_membership(message, now)

    def _handle_membership(self, message: ToWorker, now: float) -> None:
        """Handle an answer that accepts, questions, stops or refuses this process."""
        match message:
            case Welcome():
                self._take_part(message, now)
            case Greet():
                if self.joined:
                    self.joined, self._hello_at = False, now
            case Stop(reason):
                self._dismissed, self._dismissal = True, reason
            case Refused(reason, later):
                kind = UnavailableError if later else TangramError
                raise kind(
                    f"the master at {self._connection.place} refused this {self._role}: {reason}"
                )

    def _take_part(self, welcome: Welcome, now: float) -> None:
        sockets, address = self._connection.sockets, self._connection.address
        another = welcome.epoch != self.newest.epoch  # another master, which may give another index
        if (self.joined and not another) or sockets is None or address is None:
            return
        wanted = address.run_id if self._welcome is None else self._welcome.run_id
        if wanted and wanted != welcome.run_id:
            raise TangramError(
                f"the master at {address.endpoint} runs '{welcome.run_id}', not '{wanted}': the "
                "connection file is stale, use the one of a master that is running"
            )
        if self._welcome is not None and self._welcome.lockstep != welcome.lockstep:
            raise TangramError("the master has another service.mode now: start this worker again")
        self._welcome, self.joined, self._connection.keys_refused = welcome, True, False
        self.outbox.window = min(self._window, welcome.window)
        self.newest.begin(welcome.epoch)
        if another:  # it may have lost what was played for the last order, and give it again
            self._order, self._again = None, not self.outbox
        sockets.subscribe(reachable(welcome.weights_endpoint, host_of(address.endpoint)))
        self._want_weights()
        self._heartbeat_at = now + self._timing.heartbeat_s
        self._be_patient(now)
        self._post_all()

    def _take_back(self, reject: Reject, now: float) -> None:
        self.counters["rejected" if reject.final else "out_of_turn"] += 1
        self._warn("rejected", "the master at %s refused a message: %s", reject.reason)
        if reject.final:
            self._again = self.outbox.remove(reject.sequence) or self._again
        elif GAP in reject.reason and reject.sequence == self.outbox.first:
            # The batch before was refused by a master that was killed: HELLO tells what is first.
            self.joined, self._hello_at = False, now + self._timing.retry_s
        else:
            self._resend_at = min(self._resend_at, now + self._patience * self._timing.retry_s)

    def _warn(self, event: str, text: str, reason: object) -> None:
        log.warning(text, self._connection.place, reason, extra={"event": event})
