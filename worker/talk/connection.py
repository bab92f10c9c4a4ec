"""The connection to the master; it is opened again after silence or a failed handshake."""

import logging
import math
import secrets
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import zmq
from zmq.utils.monitor import recv_monitor_message

from tangram_core.errors import RunError, TangramError, UnavailableError
from tangram_core.wire.addresses import KEEPALIVE
from tangram_core.wire.arrays import MAX_WEIGHTS_BYTES
from tangram_core.wire.schema import MAX_HEADER
from worker.talk.discovery import (
    PATIENCE_S,
    MasterAddress,
    find_master,
    host_error,
    keys_error,
    no_file_error,
)

LINGER_MS = 1000
# Larger than any window, so only heartbeats to an absent master can fill the queue.
HIGH_WATER = 2048
RECONNECT_MS = 100
RECONNECT_MAX_MS = 2000
SURE = 8  # unexplained failed handshakes that mean wrong keys; under load a few fail anyway
HANDSHAKES = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Timing:
    """Timeouts and intervals, in seconds.

    Attributes:
        join_s: longest wait for the master at the start.
        retry_s: between two HELLOs, and before a resend that the master asked for.
        heartbeat_s: between two heartbeats.
        resend_s: without an acknowledgement until all batches are sent again. The wait doubles each
            time, up to eight times this value.
        silence_s: without an answer until the connection is closed and opened again.
        lost_s: without an answer, over all connections, until the worker gives up.
    """

    join_s: float = PATIENCE_S
    retry_s: float = 1.0
    heartbeat_s: float = 2.0
    resend_s: float = 10.0
    silence_s: float = 30.0
    lost_s: float = 600.0


class Sockets:
    """A DEALER socket for messages, and a SUB socket that keeps only the newest weights.

    Each DEALER gets a new identity, because a ROUTER ignores a second connection with an identity
    that seems to be still connected.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], address: MasterAddress, role: str = ""
    ) -> None:
        """Connect with the key of `role`, or any key if empty; RunError if the key is missing."""
        self._context, self._address = context, address
        self._key = _key_of(address, role)
        self._sub: zmq.Socket[bytes] | None = None
        self._weights_endpoint = ""
        self._doubts = 0
        self._poller = zmq.Poller()
        self._ready: set[zmq.Socket[bytes]] = set()
        self._dealer = self._open(zmq.DEALER)
        # ZeroMQ forbids identities that begin with a zero byte.
        self._dealer.setsockopt(zmq.IDENTITY, b"w" + secrets.token_bytes(16))
        self._monitor = self._dealer.get_monitor_socket(HANDSHAKES)
        self._poller.register(self._monitor, zmq.POLLIN)
        self._connect(self._dealer, address.endpoint)

    def subscribe(self, weights_endpoint: str) -> None:
        """Subscribe to the weights broadcast at this address, and end any other subscription."""
        if weights_endpoint == self._weights_endpoint:
            return
        self._drop_sub()
        self._sub = self._open(zmq.SUB)
        self._sub.setsockopt(zmq.CONFLATE, 1)
        self._sub.setsockopt(zmq.SUBSCRIBE, b"")
        self._connect(self._sub, weights_endpoint)
        self._weights_endpoint = weights_endpoint

    def wait(self, timeout_s: float) -> None:
        """Wait for input, at most `timeout_s`; the other methods read only what this call found."""
        events = self._poller.poll(math.ceil(max(0.0, timeout_s) * 1000))
        self._ready = {socket for socket, _ in events}

    def send(self, frames: Sequence[bytes]) -> bool:
        """Queue a message; False if there is no room."""
        try:
            self._dealer.send_multipart(frames, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def messages(self) -> Iterator[list[bytes]]:
        """Messages that had come by the last `wait`, and those that come while iterating."""
        if self._dealer not in self._ready:
            return
        while True:
            try:
                frames = self._dealer.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._doubts = 0  # the keys are right
            yield frames

    def weights(self) -> bytes | None:
        """The newest broadcast frame if the last `wait` found one, else None."""
        if self._sub is None or self._sub not in self._ready:
            return None
        try:
            return self._sub.recv(zmq.NOBLOCK)
        except zmq.Again:
            return None

    def handshake_failed(self) -> bool:
        """Whether the handshake failed because encryption or keys do not match.

        A wrong master key looks like a connection lost during the handshake, so a single such event
        proves nothing: SURE of them count as a failure.
        """
        if self._monitor not in self._ready:
            return False
        while self._monitor.poll(0):
            event = recv_monitor_message(self._monitor)["event"]
            self._doubts += 1 if event == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL else SURE
        failed = self._doubts >= SURE
        self._doubts = 0 if failed else self._doubts
        return failed

    def close(self, linger_ms: int = 0) -> None:
        """Close both sockets; queued messages have `linger_ms` to be sent."""
        self._drop_sub()
        self._dealer.disable_monitor()
        self._monitor.close(0)
        self._dealer.close(linger_ms)

    def _drop_sub(self) -> None:
        if self._sub is not None:
            self._poller.unregister(self._sub)
            self._sub.close(0)
            self._sub = None

    def _open(self, kind: int) -> zmq.Socket[bytes]:
        socket = self._context.socket(kind)
        socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        socket.setsockopt(zmq.RCVHWM, HIGH_WATER)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_WEIGHTS_BYTES + MAX_HEADER)
        for name, value in KEEPALIVE.items():
            socket.setsockopt(getattr(zmq, name), value)
        socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_MAX_MS)
        if self._key is not None:
            public, secret = self._key
            socket.setsockopt(zmq.CURVE_SERVERKEY, self._address.server_key.encode())
            socket.setsockopt(zmq.CURVE_PUBLICKEY, public.encode())
            socket.setsockopt(zmq.CURVE_SECRETKEY, secret.encode())
        self._poller.register(socket, zmq.POLLIN)
        return socket

    def _connect(self, socket: zmq.Socket[bytes], endpoint: str) -> None:
        socket.setsockopt(zmq.IPV6, int("[" in endpoint))
        try:
            socket.connect(endpoint)
        except zmq.ZMQError as error:
            raise RunError(
                f"cannot connect to {endpoint} ({error.strerror}): it must be tcp://host:port"
            ) from None


def _key_of(address: MasterAddress, role: str) -> tuple[str, str] | None:
    """Public and secret key to connect with; None without encryption."""
    if not address.keys:
        return None
    if role and role not in address.keys:
        there = " and ".join(address.keys)
        raise RunError(
            f"the connection file of {address.endpoint} has a key for role={there} only: add "
            f"role={there}, or ask for a key for role={role} (made by tangram-keys)"
        )
    return address.keys[role] if role else next(iter(address.keys.values()))


class Connection:
    """One pair of sockets at a time; a later pair may have another address.

    Attributes:
        sockets: the present pair; None before the address is known.
        address: the master's address; None while unknown.
        keys_refused: whether the last handshake failed because the keys are wrong.
    """

    def __init__(
        self, connect: str, timing: Timing, counters: Counter[str], role: str = ""
    ) -> None:
        self.sockets: Sockets | None = None
        self.address: MasterAddress | None = None
        self.keys_refused = False
        self._connect, self._timing, self._counters = connect, timing, counters
        self._role = role
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        # Since when an answer is due: on this connection, and over earlier silent connections.
        self._asked_at: float | None = None
        self._lost_at: float | None = None
        self._reopen_at, self._follow_at = math.inf, 0.0
        self._unknown_host = ""

    @property
    def place(self) -> str:
        """The master's address if known, else the setting `connect`."""
        return self.address.endpoint if self.address else self._connect

    def lacks(self, joined: bool) -> str:
        """What this process waits for; empty if it has joined and the master answers."""
        if self.address is None:
            return f"the connection file {self._connect}"
        if not joined or self._lost_at is not None:
            return f"an answer of the master at {self.place}"
        return ""

    def no_master(self, patience_s: float) -> TangramError:
        """The error for the user: no master could be joined within `patience_s`."""
        if self.keys_refused:
            return TangramError(keys_error(self._connect, self.place))
        if self.address is None:
            return UnavailableError(no_file_error(self.place, patience_s))
        if self._unknown_host:
            told = f"no master was found in {patience_s:g} s: {self._unknown_host}"
            return UnavailableError(told)
        return UnavailableError(
            f"no master answers at {self.place} after {patience_s:g} s: is tangram-master running "
            "there?"
        )

    def open(self) -> bool:
        """Connect to the present address of the master; False while it is unknown."""
        before, self.address = self.address, find_master(self._connect)
        if self.address is None:
            return False
        if self.address != before or self._unknown_host:
            self._look_up(self.address.endpoint)
        self.sockets = Sockets(self._context, self.address, self._role)
        return True

    def _look_up(self, endpoint: str) -> None:
        """Warn if DNS does not know the host (yet); ZeroMQ itself would retry silently."""
        before, self._unknown_host = self._unknown_host, host_error(endpoint, self._connect)
        if self._unknown_host and not before:
            log.warning("%s", self._unknown_host, extra={"event": "unknown_host"})

    def drop(self) -> None:
        """Close a connection that gives no answers."""
        self._counters["reconnects"] += 1
        if self._lost_at is None:
            self._lost_at = self._asked_at
        self._asked_at, self._reopen_at = None, math.inf
        if self.sockets is not None:
            self.sockets.close()
            self.sockets = None

    def asked(self, now: float) -> None:
        """Record that a message was sent which needs an answer."""
        if self._asked_at is None:
            self._asked_at = now

    def answered(self) -> None:
        """Record that a message of the master arrived."""
        if self._lost_at is not None:
            log.info("the master at %s answers again", self.place, extra={"event": "found_again"})
        self._asked_at = self._lost_at = None

    def watch(self, now: float) -> None:
        """Plan to connect again if the master has a new address or a handshake has failed."""
        self._follow(now)
        if self.sockets is None or not self.sockets.handshake_failed():
            return
        self._counters["handshakes_failed"] += 1
        if not self.keys_refused:
            log.warning(
                "%s", keys_error(self._connect, self.place), extra={"event": "keys_refused"}
            )
        self.keys_refused, self._reopen_at = True, now + self._timing.retry_s

    def is_dead(self, now: float, joined_before: bool) -> bool:
        """Whether to try another connection; warn of silence if a master had answered before."""
        silent = self._asked_at is not None and now - self._asked_at > self._timing.silence_s
        if silent and joined_before and self._lost_at is None and not self.keys_refused:
            log.warning(
                "the master at %s has not answered for %g s: tries again for %g s",
                self.place,
                self._timing.silence_s,
                self._timing.lost_s - self._timing.silence_s,
                extra={"event": "silent"},
            )
        return silent or now >= self._reopen_at

    def _follow(self, now: float) -> None:
        """Plan to connect again if the connection file has a new address, as after a restart."""
        if now < self._follow_at:
            return
        self._follow_at = now + self._timing.retry_s
        try:
            found = find_master(self._connect)
        except RunError:
            return  # perhaps half written: look again next time
        if found is not None and found != self.address:
            log.info("the master is at %s now", found.endpoint, extra={"event": "moved"})
            self._reopen_at = now

    def check_lost(self, now: float) -> None:
        """Raise UnavailableError after `lost_s` without an answer, over all connections."""
        if self._lost_at is not None and now - self._lost_at > self._timing.lost_s:
            raise UnavailableError(
                f"the master at {self.place} has not answered for {self._timing.lost_s:g} s: "
                "is it still running?"
            )

    def close(self) -> None:
        """Close the connection; queued messages have a second to be sent."""
        if self.sockets is not None:
            self.sockets.close(LINGER_MS)
            self.sockets = None
        self._context.destroy(linger=LINGER_MS)
