"""Limits on connections: how many in all, and how many that are not authenticated yet.

ZeroMQ limits neither, and it buffers a frame of each connection before authentication. It reports
each connection that it accepts or loses. An excess connection is shut down by the number of its
descriptor; to ZeroMQ this looks like a disconnect by the other side.
"""

import resource
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Thread

import zmq

from master.record.counters import Counters
from tangram_core.errors import ConfigError

# Most connections that are not authenticated yet. One more ends the oldest: a handshake takes
# milliseconds, so the oldest is idle. Within MOVING_S after any successful handshake it ends the
# newest instead, since many workers may be joining. A worker that is hit connects again by itself.
HANDSHAKES = 32
MOVING_S = 0.1
MAX_PEERS = 4096
DESCRIPTORS = 2  # for each worker
RESERVE = 192  # descriptors for files, HTTP and ZeroMQ itself
MOST_FILES = RESERVE + HANDSHAKES + DESCRIPTORS * MAX_PEERS
# At least so many bytes were sent on an encrypted connection that is authenticated: greeting,
# WELCOME and READY. Before that they are 234, or 246 with an error.
LET_IN = 250
SENT = struct.Struct("=QQ")  # tcpi_bytes_sent and tcpi_bytes_retrans of Linux' struct tcp_info
SENT_AT = 200  # their offset there
EVENT = struct.Struct("=HI")
# A monitor and a descriptor, which another socket may use before this monitor tells of the end.
Connection = tuple[object, int]
EVENTS = (
    zmq.EVENT_ACCEPTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_MONITOR_STOPPED
)


@dataclass(frozen=True)
class Room:
    """Limits on connections and peers, from the limit on open files.

    Attributes:
        files: how many files this process may have open.
    """

    files: int

    @staticmethod
    def here() -> "Room":
        """Set this process's limit on open files; ConfigError if no worker fits."""
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        room = Room(MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES))
        if room.peers < 1:
            raise ConfigError(
                f"this process may open {room.files} files, too few for one worker: raise the hard "
                f"limit (ulimit -Hn) to at least {RESERVE + HANDSHAKES + DESCRIPTORS}"
            )
        resource.setrlimit(resource.RLIMIT_NOFILE, (room.files, hard))
        return room

    @property
    def connections(self) -> int:
        """Most connections at a time."""
        return min(self.files, MOST_FILES) - RESERVE

    @property
    def peers(self) -> int:
        """Most processes that take part at a time."""
        return (self.connections - HANDSHAKES) // DESCRIPTORS

    @property
    def bound(self) -> str:
        """End of a message about a full master: what sets the limit, and how to raise it."""
        if self.files >= MOST_FILES:
            return "there can be"
        return f"that {self.files} open files allow: raise ulimit -Hn and start the master again"


AMPLE = Room(MOST_FILES)


class Gate:
    """Watches the connections of bound sockets in a thread, and ends the excess ones.

    The limit on connections without authentication holds only if the sockets are encrypted.
    """

    def __init__(
        self,
        sockets: Sequence["zmq.Socket[bytes]"],
        room: Room,
        encrypted: bool,
        counters: Counters,
    ) -> None:
        self._sockets, self._room, self._counters = sockets, room, counters
        self._encrypted = encrypted
        self._open, self._moved = set[Connection](), 0.0
        self._waiting = dict[Connection, str]()  # their addresses, in the order they came
        self._doors = {_door(s.getsockopt_string(zmq.LAST_ENDPOINT)) for s in sockets}
        self._monitors = [s.get_monitor_socket(EVENTS) for s in sockets]
        self._thread = Thread(target=self._watch, name="gate", daemon=True)
        self._thread.start()

    def end_all(self, endpoint: str) -> None:
        """End all connections of a socket; workers with a valid key then connect again."""
        for one in range(self._room.files):  # the thread may hear late of the newest ones
            with suppress(OSError), _connection(one) as found:
                found.getpeername()  # OSError for the socket that listens
                if _door(_named(found.getsockname())) == _door(endpoint):
                    found.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End the thread; call this before the sockets are closed."""
        for one in self._sockets:
            one.disable_monitor()
        self._thread.join()
        for monitor in self._monitors:
            monitor.close(0)

    def _watch(self) -> None:
        """Handle events until all monitors have stopped: ZeroMQ blocks if they are not read."""
        poller, left = zmq.Poller(), len(self._monitors)
        for monitor in self._monitors:
            poller.register(monitor, zmq.POLLIN)
        while left:
            for monitor, _ in poller.poll():
                left -= self._handle(monitor, monitor.recv_multipart()[0])

    def _handle(self, monitor: object, told: bytes) -> bool:
        """Handle one event; whether the monitor has stopped."""
        event, descriptor = EVENT.unpack(told)
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:  # ZeroMQ does not say of which
            self._moved = time.monotonic()
        elif event != zmq.EVENT_MONITOR_STOPPED:
            one = monitor, descriptor
            self._open.discard(one)
            self._waiting.pop(one, None)
            if event == zmq.EVENT_ACCEPTED:
                self._accepted(one)
        return bool(event == zmq.EVENT_MONITOR_STOPPED)

    def _accepted(self, one: Connection) -> None:
        self._open.add(one)
        descriptor = one[1]
        # The connection may be closed already, and the number of its descriptor used again. Then
        # the next event tells that it was closed.
        with suppress(OSError), _connection(descriptor) as found:
            self._waiting[one] = _named(found.getpeername())
        if len(self._open) > self._room.connections:
            reason = f"{self._room.connections} are open already, the most {self._room.bound}"
            self._end(one, "refused_connections", reason)
        while self._encrypted and len(self._waiting) > HANDSHAKES:
            self._make_room()

    def _make_room(self) -> None:
        """Remove one waiting connection from the list: authenticated by now, or ended here."""
        first, last = next(iter(self._waiting)), next(reversed(self._waiting))
        with suppress(OSError), _connection(first[1]) as found:
            if _let_in(found):
                del self._waiting[first]
                return
        workers = time.monotonic() - self._moved < MOVING_S
        reason = f"more than {HANDSHAKES} show no key"
        self._end(last if workers else first, "refused_handshakes", reason)

    def _end(self, one: Connection, counter: str, reason: str) -> None:
        """End a connection, unless it is authenticated or the descriptor is another one now."""
        address, descriptor = self._waiting.pop(one, None), one[1]
        with suppress(OSError), _connection(descriptor) as found:
            mine = _door(_named(found.getsockname())) in self._doors
            mine &= _named(found.getpeername()) == address
            if mine and not (self._encrypted and _let_in(found)):
                found.shutdown(socket.SHUT_RDWR)
                self._counters.note(counter, f"connection of {address}: {reason}")


def _named(address: tuple[str, int] | str) -> str:
    """Host and port as text; for a unix socket its path, empty for the client's side."""
    return address if isinstance(address, str) else f"{address[0]}:{address[1]}"


def _door(endpoint: str) -> str:
    """A socket's port or path, which tells the sockets of this process apart on any address."""
    return endpoint.removeprefix("ipc://").rpartition(":")[2]


@contextmanager
def _connection(descriptor: int) -> Iterator[socket.socket]:
    """A connection by its number; no descriptor is taken, as strangers may have taken all."""
    found = socket.socket(fileno=descriptor)
    try:
        yield found
    finally:
        found.detach()


def _let_in(connection: socket.socket) -> bool:
    """Whether an encrypted connection is authenticated, by the number of bytes sent on it."""
    info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, SENT_AT + SENT.size)
    if len(info) < SENT_AT + SENT.size:
        return True  # unknown before Linux 4.19
    sent, again = SENT.unpack_from(info, SENT_AT)
    return int(sent - again) >= LET_IN
