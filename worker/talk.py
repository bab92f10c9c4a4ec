"""What a worker says to the master and when: HELLO, heartbeats, resends, a new connection.

Delivery: a batch is sent again, with all that are unacknowledged and in order, after each WELCOME
(a new connection, a restarted master), when the master got one out of turn, and when no
acknowledgement came for a while. The master drops what it has already.
"""

import logging
import secrets
import time
from collections import Counter

from tangram_agent.addresses import host_of, reachable
from tangram_agent.arrays import WeightShapes
from tangram_agent.messages import (
    Ack,
    Alive,
    Bye,
    Go,
    Greet,
    Heartbeat,
    Hello,
    Refused,
    Reject,
    RunStatus,
    Stop,
    ToWorker,
    WantWeights,
    WeightsMessage,
    Welcome,
    decode_from_master,
)
from tangram_agent.schema import Plain, ProtocolError
from tangram_sim.errors import TangramError, WireError
from worker.channel import Channel
from worker.inbox import Inbox
from worker.line import Line
from worker.spool import Spool
from worker.terms import Introduction, Timing

log = logging.getLogger(__name__)


class Talk:
    """The state of one process's conversation; `step` carries it on.

    Attributes:
        spool: unacknowledged batches.
        inbox: weights.
        stats: numbers for the next heartbeats.
        counters: what was sent again, refused, lost or not understood.
        welcome: the master's last one.
        order: in lockstep, the last one.
        joined: the present connection is known to the master.
        line: the connection.
        dismissed: the master wants this process to end.
        reason: that it gave.
    """

    def __init__(
        self, who: Introduction, window: int, shapes: WeightShapes | None, timing: Timing
    ) -> None:
        self.spool, self.inbox = Spool(window), Inbox(shapes)
        self.stats: dict[str, float] = {}
        self.counters: Counter[str] = Counter()
        self.line = Line(who.connect, timing, self.counters)
        self.welcome: Welcome | None = None
        self.order: Go | None = None
        self.joined = self.dismissed = False
        self.reason = ""
        self._who, self._window, self._shapes, self._timing = who, window, shapes, timing
        self._process = secrets.token_hex(16)
        self._hello_at = self._heartbeat_at = self._resend_at = 0.0

    @property
    def lacks(self) -> str:
        """What nothing goes on without, empty while the master answers."""
        if not self.line.found:
            return f"the connection file {self._who.connect}"
        if not self.joined or self.line.is_waiting:
            return f"an answer of the master at {self.line.place}"
        return ""

    def step(self, timeout_s: float) -> None:
        """Wait at most so long for something to come, then answer and do what is due.

        Raises:
            TangramError: refused, another run, or without an answer for `lost_s`.
        """
        channel = self.line.channel or self._open()
        if channel is None:  # nothing to wait for but the file
            time.sleep(timeout_s)
        else:
            channel.wait(timeout_s)
            self.line.look(time.monotonic())
            self._receive_weights(channel)
            for frames in channel.messages():
                self._receive(frames)
            self._do_what_is_due(channel, time.monotonic())
        self.line.check_lost(time.monotonic())

    def post(self, frames: list[bytes]) -> bool:
        """Send to a master that knows this connection; False if that was not possible."""
        return self.joined and self.line.channel is not None and self.line.channel.send(frames)

    def post_next(self, frames: list[bytes]) -> None:
        """Keep the spool's next message and send it."""
        if not self.spool:
            self._resend_at = time.monotonic() + self._timing.resend_s
        self.spool.add(frames)
        self.post(frames)

    def close(self, reason: str) -> None:
        """Say BYE and close; bounded, also when nobody listens."""
        if self.line.channel is not None:
            self.line.channel.send(Bye(reason).encode())
        self.line.close()

    def _open(self) -> Channel | None:
        if self.line.open() and self.line.channel is not None:
            self._say_hello(self.line.channel, time.monotonic())
        return self.line.channel

    def _do_what_is_due(self, channel: Channel, now: float) -> None:
        timing = self._timing
        if self.line.is_dead(now):
            self.joined = False
            self.line.drop()
            self._open()
        elif not self.joined:
            if now >= self._hello_at:
                self._say_hello(channel, now)
        else:
            if now >= self._heartbeat_at:
                self._heartbeat_at = now + timing.heartbeat_s
                self._ask(channel, Heartbeat(self.stats), now)
            if self.spool and now >= self._resend_at:
                self._resend(now)

    def _say_hello(self, channel: Channel, now: float) -> None:
        known = self.welcome
        hello = Hello(
            role=self._who.role,
            index=self._who.index if known is None else known.index,
            incarnation=0 if known is None else known.incarnation,
            process=self._process,
            first=self.spool.first,
            fingerprints=self._who.fingerprints,
        )
        self._hello_at = now + self._timing.retry_s
        self._ask(channel, hello, now)

    def _ask(self, channel: Channel, question: Plain, now: float) -> None:
        self.line.asked(now)
        channel.send(question.encode())

    def _resend(self, now: float) -> None:
        self._resend_at = now + self._timing.resend_s
        for frames in self.spool.messages:
            self.counters["resent"] += 1
            self.post(frames)

    def _receive(self, frames: list[bytes]) -> None:
        try:
            message = decode_from_master(frames, self._shapes)
        except ProtocolError:
            raise
        except WireError as error:
            self.counters["malformed"] += 1
            self._warn("malformed", "the master at %s sent what is not understood: %s", error)
            return
        self.line.answered()
        if not isinstance(message, RunStatus):  # nobody asked for one here
            self._handle(message, time.monotonic())

    def _receive_weights(self, channel: Channel) -> None:
        frame = channel.weights()
        if frame is None:
            return
        try:
            self.inbox.offer_frame(frame)
        except WireError as error:
            self.counters["malformed"] += 1
            self._warn("bad_weights", "weights from %s are refused: %s", error)

    def _handle(self, message: ToWorker, now: float) -> None:
        match message:
            case Ack(sequence):
                if self.spool.remove(sequence):
                    self._resend_at = now + self._timing.resend_s
            case Reject():
                self._take_back(message, now)
            case Go():
                self.order = message
            case Alive(version):
                if self.inbox.version < version:  # the broadcast was missed, or is on its way
                    self._want_weights()
            case WeightsMessage(epoch, weights):
                self.inbox.offer(epoch, weights)
            case _:
                self._handle_standing(message, now)

    def _handle_standing(self, message: ToWorker, now: float) -> None:
        """Whether this process takes part."""
        match message:
            case Welcome():
                self._join(message, now)
            case Greet():
                if self.joined:
                    self.joined, self._hello_at = False, now
            case Stop(reason):
                self.dismissed, self.reason = True, reason
            case Refused(reason):
                raise TangramError(
                    f"the master at {self.line.place} refused this {self._who.role}: {reason}"
                )

    def _join(self, welcome: Welcome, now: float) -> None:
        channel, found = self.line.channel, self.line.found
        if self.joined or channel is None or found is None:
            return
        wanted = found.run_id if self.welcome is None else self.welcome.run_id
        if wanted and wanted != welcome.run_id:
            raise TangramError(
                f"the master at {self.line.place} runs '{welcome.run_id}', not '{wanted}': the "
                "connection file is stale, take the one of a master that is running"
            )
        self.welcome, self.joined, self.line.stranger = welcome, True, False
        self.spool.window = min(self._window, welcome.window)
        self.inbox.begin(welcome.epoch)
        channel.subscribe(reachable(welcome.weights_endpoint, host_of(found.endpoint)))
        self._want_weights()
        self._heartbeat_at = now + self._timing.heartbeat_s
        self._resend(now)

    def _want_weights(self) -> None:
        self.post(WantWeights(self.inbox.epoch, self.inbox.version).encode())

    def _take_back(self, reject: Reject, now: float) -> None:
        self.counters["rejected" if reject.final else "out_of_turn"] += 1
        self._warn("rejected", "the master at %s refused a message: %s", reject.reason)
        if reject.final:
            self.spool.remove(reject.sequence)
        else:
            self._resend_at = min(self._resend_at, now + self._timing.retry_s)

    def _warn(self, event: str, text: str, reason: object) -> None:
        log.warning(text, self.line.place, reason, extra={"event": event})
