"""A worker's two sockets for one connection to the master: DEALER, and SUB for weights."""

import math
import secrets
from collections.abc import Iterator, Sequence

import zmq
from zmq.utils.monitor import recv_monitor_message

from tangram_agent.arrays import MAX_WEIGHTS_BYTES
from tangram_agent.schema import MAX_HEADER
from tangram_sim.errors import RunError
from worker.connection import Connection

LINGER_MS = 1000
# More than any window, so that only heartbeats to a master that is away find no room.
HIGH_WATER = 2048
# ZMTP pings find connections that died without a word.
PING_MS = 5000
RECONNECT_MS = 100
RECONNECT_MAX_MS = 2000
SURE = 3  # handshakes in a row that failed without a reason
HANDSHAKES = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)


class Channel:
    """A DEALER with an identity of its own, and one SUB that keeps the newest frame only.

    A fresh channel has a fresh identity: a ROUTER ignores a second connection of an identity that
    it believes alive.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], found: Connection) -> None:
        self._context, self._found = context, found
        self._sub: zmq.Socket[bytes] | None = None
        self._weights_endpoint = ""
        self._doubts = 0
        self._poller = zmq.Poller()
        self._ready: set[zmq.Socket[bytes]] = set()
        self._dealer = self._open(zmq.DEALER)
        # The first byte must not be zero.
        self._dealer.setsockopt(zmq.IDENTITY, b"w" + secrets.token_bytes(16))
        self._monitor = self._dealer.get_monitor_socket(HANDSHAKES)
        self._poller.register(self._monitor, zmq.POLLIN)
        self._connect(self._dealer, found.endpoint)

    def subscribe(self, weights_endpoint: str) -> None:
        """Listen for weights there, and nowhere else."""
        if weights_endpoint == self._weights_endpoint:
            return
        self._drop_sub()
        self._sub = self._open(zmq.SUB)
        self._sub.setsockopt(zmq.CONFLATE, 1)
        self._sub.setsockopt(zmq.SUBSCRIBE, b"")
        self._connect(self._sub, weights_endpoint)
        self._weights_endpoint = weights_endpoint

    def wait(self, timeout_s: float) -> None:
        """Return when something came, or after this time; what came is looked at after this."""
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
        """What the master had answered by the last `wait`, and what comes meanwhile."""
        if self._dealer not in self._ready:
            return
        while True:
            try:
                frames = self._dealer.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            yield frames

    def weights(self) -> bytes | None:
        """The newest broadcast that was there at the last `wait`."""
        if self._sub is None or self._sub not in self._ready:
            return None
        try:
            return self._sub.recv(zmq.NOBLOCK)
        except zmq.Again:
            return None

    def handshake_failed(self) -> bool:
        """Whether the two sides do not agree on encryption and keys.

        A wrong key of the master looks like a connection that was lost in the handshake: only
        several of these count.
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
        """Close both sockets; what is queued gets so long."""
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
        socket.setsockopt(zmq.LINGER, LINGER_MS)
        socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        socket.setsockopt(zmq.RCVHWM, HIGH_WATER)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_WEIGHTS_BYTES + MAX_HEADER)
        socket.setsockopt(zmq.HEARTBEAT_IVL, PING_MS)
        socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_MAX_MS)
        if self._found.server_key:
            socket.setsockopt(zmq.CURVE_SERVERKEY, self._found.server_key.encode())
            socket.setsockopt(zmq.CURVE_PUBLICKEY, self._found.public_key.encode())
            socket.setsockopt(zmq.CURVE_SECRETKEY, self._found.secret_key.encode())
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
