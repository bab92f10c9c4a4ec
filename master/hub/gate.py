"""The door of the sockets: how many connections there may be, and how many without a key yet.

ZeroMQ bounds neither, and holds a frame for each that comes before anybody has shown a key. It
tells of every connection that it accepts or loses. One that is too much is shut down from outside,
which ZeroMQ takes for the end of the other side.
"""

import os
import resource
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from threading import Thread

import zmq

from master.record.counters import Counters
from tangram_core.errors import ConfigError

# Connections that have shown no key, at a time. For one more the oldest is ended: a handshake takes
# milliseconds, so it is idle. While others show keys, so long after each, the newest is: then it is
# one of many workers. A worker that is hit comes again by itself.
HANDSHAKES = 32
MOVING_S = 0.1
MAX_PEERS = 4096
DESCRIPTORS = 2  # of each worker
RESERVE = 192  # descriptors for files, HTTP and ZeroMQ itself
MOST_FILES = RESERVE + HANDSHAKES + DESCRIPTORS * MAX_PEERS
# Bytes that the master has sent over an encrypted connection when it has taken the key: greeting,
# WELCOME and READY. Before that they are 234, or 246 with an error.
LET_IN = 250
SENT = struct.Struct("=QQ")  # tcpi_bytes_sent and tcpi_bytes_retrans of Linux' struct tcp_info,
SENT_AT = 200  # which stand here
EVENT = struct.Struct("=HI")
EVENTS = (
    zmq.EVENT_ACCEPTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_MONITOR_STOPPED
)


@dataclass(frozen=True)
class Room:
    """How many may take part.

    Attributes:
        files: that this process may have open.
    """

    files: int

    @staticmethod
    def here() -> "Room":
        """As much as this process has or may take; ConfigError if there is none for a worker."""
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        soft, hard = (MOST_FILES if n == resource.RLIM_INFINITY else n for n in limits)
        room = Room(max(soft, min(hard, MOST_FILES)))
        if room.peers < 1:
            raise ConfigError(
                f"this process may open {room.files} files, which leaves none for a worker: allow "
                f"at least {RESERVE + HANDSHAKES + DESCRIPTORS} (ulimit -n)"
            )
        if soft < room.files:
            resource.setrlimit(resource.RLIMIT_NOFILE, (room.files, limits[1]))
        return room

    @property
    def connections(self) -> int:
        """At a time."""
        return min(self.files, MOST_FILES) - RESERVE

    @property
    def peers(self) -> int:
        """Processes that take part."""
        return (self.connections - HANDSHAKES) // DESCRIPTORS

    @property
    def bound(self) -> str:
        """What sets the most, in words, and how to get more."""
        if self.files >= MOST_FILES:
            return "there can be"
        return f"that {self.files} open files allow: raise ulimit -n and start the master again"


AMPLE = Room(MOST_FILES)


class Gate:
    """Watches the connections of bound sockets, in a thread of its own.

    Where they are encrypted, who has shown no key is a stranger; else there are none.
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
        self._open, self._moved = set[int](), 0.0
        self._waiting = dict[int, str]()  # descriptor -> address, in the order they came
        self._doors = {_door(s.getsockopt_string(zmq.LAST_ENDPOINT)) for s in sockets}
        self._monitors = [s.get_monitor_socket(EVENTS) for s in sockets]
        self._thread = Thread(target=self._watch, name="gate", daemon=True)
        self._thread.start()

    def end_all(self, endpoint: str) -> None:
        """End all connections of a socket; those who may come connect again."""
        for descriptor in list(self._open):
            with suppress(OSError), _connection(descriptor) as found:
                if _door(_named(found.getsockname())) == _door(endpoint):
                    found.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End the thread, before the sockets are closed."""
        for one in self._sockets:
            one.disable_monitor()
        self._thread.join()
        for monitor in self._monitors:
            monitor.close(0)

    def _watch(self) -> None:
        """Until both monitors have stopped: ZeroMQ waits for whoever does not read them."""
        poller, left = zmq.Poller(), len(self._monitors)
        for monitor in self._monitors:
            poller.register(monitor, zmq.POLLIN)
        while left:
            for monitor, _ in poller.poll():
                event, descriptor = EVENT.unpack(monitor.recv_multipart()[0])
                if event == zmq.EVENT_MONITOR_STOPPED:
                    left -= 1
                elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:  # whose is not told
                    self._moved = time.monotonic()
                else:
                    self._open.discard(descriptor)
                    self._waiting.pop(descriptor, None)
                    if event == zmq.EVENT_ACCEPTED:
                        self._accepted(descriptor)

    def _accepted(self, descriptor: int) -> None:
        self._open.add(descriptor)
        # What is closed meanwhile is told next; its descriptor may be of something else by now.
        with suppress(OSError), _connection(descriptor) as found:
            self._waiting[descriptor] = _named(found.getpeername())
        if len(self._open) > self._room.connections:
            reason = f"{self._room.connections} are open already, the most {self._room.bound}"
            self._end(descriptor, "refused_connections", reason)
        while self._encrypted and len(self._waiting) > HANDSHAKES:
            self._make_room()

    def _make_room(self) -> None:
        """Strike out one that has shown its key meanwhile, or end one."""
        first, last = next(iter(self._waiting)), next(reversed(self._waiting))
        with suppress(OSError), _connection(first) as found:
            if _let_in(found):
                del self._waiting[first]
                return
        workers = time.monotonic() - self._moved < MOVING_S
        reason = f"more than {HANDSHAKES} show no key"
        self._end(last if workers else first, "refused_handshakes", reason)

    def _end(self, descriptor: int, counter: str, reason: str) -> None:
        """End a connection, unless it is another one by now, or has shown a key."""
        address = self._waiting.pop(descriptor, None)
        with suppress(OSError), _connection(descriptor) as found:
            mine = _door(_named(found.getsockname())) in self._doors
            mine &= _named(found.getpeername()) == address
            if mine and not (self._encrypted and _let_in(found)):
                found.shutdown(socket.SHUT_RDWR)
                self._counters.note(counter, f"connection of {address}: {reason}")


def _named(address: tuple[str, int] | str) -> str:
    """Host and port, or a path, empty for the other side of a unix socket."""
    return address if isinstance(address, str) else f"{address[0]}:{address[1]}"


def _door(endpoint: str) -> str:
    """What tells the sockets of this process apart, on whatever address: a port, or a path."""
    return endpoint.removeprefix("ipc://").rpartition(":")[2]


def _connection(descriptor: int) -> socket.socket:
    """A second handle of a connection, which stays this one's when the first is closed."""
    return socket.socket(fileno=os.dup(descriptor))


def _let_in(connection: socket.socket) -> bool:
    """Whether the master has taken the key of an encrypted connection."""
    info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, SENT_AT + SENT.size)
    if len(info) < SENT_AT + SENT.size:
        return True  # Linux before 4.19 does not tell
    sent, again = SENT.unpack_from(info, SENT_AT)
    return int(sent - again) >= LET_IN
