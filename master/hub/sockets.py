"""The master's two sockets: queues and closing time are bounded, and sends never wait."""

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import zmq

from master.hub.gate import AMPLE, Gate, Room
from master.hub.security import Authenticator, Holder, Keys
from master.record.audit import Audit
from master.record.counters import Counters
from tangram_core.errors import ConfigError
from tangram_core.wire.addresses import IPC, KEEPALIVE
from tangram_core.wire.arrays import MAX_FRAME_BYTES
from tangram_core.wire.schema import Message

LINGER_MS = 1000
# Messages queued for each peer and direction; more are dropped, and the peer must ask again.
HIGH_WATER = 64
# A handshake takes milliseconds, on a busy machine seconds.
HANDSHAKE_MS = 10_000
# Connections that wait to be accepted: many workers may start at once.
BACKLOG = 1024
# Bytes of a subscription or a step of a handshake; encryption adds less than this to a frame.
MAX_COMMAND = 1024
LAST_ANSWER_S = 0.5  # to send the last answer to a revoked key


class Received(NamedTuple):
    """A received message and its sender.

    Attributes:
        identity: ZeroMQ's name of the connection.
        frames: of the message.
        holder: holder of the connection's key, which may be revoked by now.
        address: network address of the sender; for a unix socket, `local` and the process id.
        public: public key of the connection; empty without keys.
    """

    identity: bytes
    frames: Sequence[bytes]
    holder: Holder
    address: str
    public: str = ""


class Sockets:
    """A bound ROUTER socket for all messages, and a bound PUB socket for broadcasts of weights."""

    def __init__(
        self,
        bind: str,
        port: int,
        counters: Counters,
        keys: Keys | None = None,
        room: Room = AMPLE,
        audit: Audit | None = None,
    ) -> None:
        self._counters = counters
        self._context = zmq.Context()
        self._gate: Gate | None = None
        self._authenticator: Authenticator | None = None
        if keys is not None:
            self._authenticator = Authenticator(self._context, keys, counters, audit or Audit())
        try:
            self._router = self._open(zmq.ROUTER, bind, port)
            self._pub = self._open(zmq.PUB, bind, port + 1 if port else 0)
        except ConfigError:
            self._close(0)
            raise
        self.endpoint = self._router.getsockopt_string(zmq.LAST_ENDPOINT)
        self.weights_endpoint = self._pub.getsockopt_string(zmq.LAST_ENDPOINT)
        self._gate = Gate((self._router, self._pub), room, keys is not None, counters)
        self._end_router_s = math.inf

    @property
    def keys(self) -> Keys | None:
        """The keys as last read from their file; None on plain sockets."""
        return None if self._authenticator is None else self._authenticator.keys

    def wait(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` for a message; returns whether there is one."""
        return bool(self._router.poll(math.ceil(max(0.0, timeout_s) * 1000)))

    def receive(self) -> Received | None:
        """The next message, or None; does not wait."""
        try:
            first = self._router.recv(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        frames = self._router.recv_multipart(zmq.NOBLOCK)
        public = "" if self._authenticator is None else _told(first, "User-Id")
        address = _told(first, "Peer-Address")
        if address and self.endpoint.startswith(IPC):  # host:user:group:process
            address = f"local, pid {address.rpartition(':')[2]}"
        return Received(first.bytes, frames, self.holder(public), address, public)

    def holder(self, public: str) -> Holder:
        """The present holder of a public key."""
        return Holder() if self._authenticator is None else self._authenticator.holder(public)

    def revoked(self) -> list[Holder]:
        """Holders of the keys revoked since the last call; all connections are ended.

        Workers with a valid key connect again. The ROUTER's end later, after the last answer.
        """
        gone = [] if self._authenticator is None else self._authenticator.revoked()
        if self._gate is not None and gone:
            self._gate.end_all(self.weights_endpoint)
            self._end_router_s = time.monotonic() + LAST_ANSWER_S
        elif self._gate is not None and time.monotonic() >= self._end_router_s:
            self._gate.end_all(self.endpoint)
            self._end_router_s = math.inf
        return gone

    def send(self, identity: bytes, frames: Sequence[bytes]) -> None:
        """Send frames to a peer; if it is gone or does not read, drop the message and count it."""
        try:
            self._router.send_multipart([identity, *frames], zmq.NOBLOCK)
        except zmq.Again:
            self._counters["congested"] += 1
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            self._counters["unreachable"] += 1

    def answer(self, identity: bytes, answer: Message) -> None:
        """Send a message to a peer; see `send`."""
        self.send(identity, answer.encode())

    def refuse(self, identity: bytes, counter: str, answer: Message) -> None:
        """Send a refusal to a peer, count it by name, and log its reason."""
        self._counters.note(counter, getattr(answer, "reason", "a connection without HELLO"))
        self.answer(identity, answer)

    def publish(self, frame: bytes) -> None:
        """Send a frame to all subscribers with room in their queue."""
        self._pub.send(frame, zmq.NOBLOCK)

    def close(self) -> None:
        """Close the sockets; queued messages get one second to be sent."""
        self._close(LINGER_MS)
        for endpoint in (self.endpoint, self.weights_endpoint):
            if endpoint.startswith(IPC):
                Path(endpoint.removeprefix(IPC)).unlink(missing_ok=True)

    def _close(self, linger_ms: int) -> None:
        if self._gate is not None:
            self._gate.close()
            self._gate = None
        if self._authenticator is not None:
            self._authenticator.close()
        self._context.destroy(linger=linger_ms)

    def _open(self, kind: int, bind: str, port: int) -> zmq.Socket[bytes]:
        socket = self._context.socket(kind)
        socket.setsockopt(zmq.LINGER, LINGER_MS)
        socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        socket.setsockopt(zmq.RCVHWM, HIGH_WATER)
        socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        socket.setsockopt(zmq.BACKLOG, BACKLOG)
        most = MAX_COMMAND + (MAX_FRAME_BYTES if kind == zmq.ROUTER else 0)
        socket.setsockopt(zmq.MAXMSGSIZE, most)
        for name, value in KEEPALIVE.items():
            socket.setsockopt(getattr(zmq, name), value)
        socket.setsockopt(zmq.IPV6, int(":" in bind))
        if kind == zmq.ROUTER:
            # Without this, answers to lost connections are dropped without an error.
            socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        if self._authenticator is not None:
            self._authenticator.guard(socket)
        host = f"[{bind}]" if ":" in bind else bind
        local = f"{bind}.{'episodes' if kind == zmq.ROUTER else 'weights'}"
        try:
            socket.bind(local if bind.startswith(IPC) else f"tcp://{host}:{port or '*'}")
        except zmq.ZMQError as error:
            if bind.startswith(IPC):
                raise ConfigError(
                    f"cannot listen at {local} ({error.strerror}): set TMPDIR to a folder of a "
                    "local disk"
                ) from None
            if error.errno == zmq.EADDRINUSE:
                raise ConfigError(
                    f"port {port} of {bind} is in use: set service.port to a number that is free "
                    "together with the next one, or to 0 for any"
                ) from None
            raise ConfigError(
                f"cannot listen on {bind}, port {port} ({error.strerror}): set service.bind to an "
                f"address of this machine, such as 127.0.0.1, and service.port to one you may use"
            ) from None
        return socket


def _told(frame: zmq.Frame, name: str) -> str:
    """A property of a frame's sender; empty if ZeroMQ does not know it.

    It is unknown if the sender does not speak ZeroMQ, or only the first version of its protocol.
    """
    try:
        return str(frame.get(name))
    except zmq.ZMQError:
        return ""
