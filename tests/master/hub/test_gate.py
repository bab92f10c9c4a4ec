"""Connections beyond a bound are ended, those of others never."""

import errno
import os
import resource
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import zmq

from master.hub.gate import (
    AMPLE,
    DESCRIPTORS,
    EVENT,
    HANDSHAKES,
    LET_IN,
    MAX_PEERS,
    MOST_FILES,
    RESERVE,
    Room,
    _connection,
    _let_in,
)
from master.hub.security import Keys, make_keys
from master.hub.sockets import MAX_COMMAND, Sockets
from master.record.counters import Counters
from tangram_core.errors import ConfigError
from tangram_core.wire.arrays import MAX_FRAME_BYTES
from tangram_lab.benchmarks.trials.strangers import connection

LIMIT_S = 100.0
FEW = RESERVE + HANDSHAKES + DESCRIPTORS


@pytest.mark.fast
@pytest.mark.parametrize(
    ("soft", "hard", "files", "peers"),
    [
        (1024, 1024, 1024, (1024 - RESERVE - HANDSHAKES) // DESCRIPTORS),
        (1024, 4096, 4096, (4096 - RESERVE - HANDSHAKES) // DESCRIPTORS),
        (FEW, FEW, FEW, 1),
        (1024, 2**20, MOST_FILES, MAX_PEERS),
        (2**19, 2**30, MOST_FILES, MAX_PEERS),  # `end_all` looks at each number
        (1024, resource.RLIM_INFINITY, MOST_FILES, MAX_PEERS),
        (resource.RLIM_INFINITY, resource.RLIM_INFINITY, MOST_FILES, MAX_PEERS),
    ],
)
def test_there_is_room_for_as_many_as_files_may_be_open(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, files: int, peers: int
) -> None:
    taken = list[tuple[int, int]]()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (soft, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: taken.append(limits))
    room = Room.here()
    assert (room.files, room.peers) == (files, peers)
    assert taken == [(files, hard)]


@pytest.mark.fast
def test_no_room_for_a_single_worker_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (100, FEW - 1))
    with pytest.raises(ConfigError) as caught:
        Room.here()
    assert str(caught.value) == (
        f"this process may open {FEW - 1} files, too few for one worker: raise the hard limit "
        f"(ulimit -Hn) to at least {FEW}"
    )


class Door:
    """Sockets that a test connects to; what comes is answered."""

    def __init__(self, keys: Keys | None, room: Room, bind: str) -> None:
        self.counters, self.keys = Counters(), keys
        self.sockets = Sockets(bind, 0, self.counters, keys, room=room)
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._strangers: list[socket.socket] = []
        self._made: list[zmq.Socket[bytes]] = []

    def stranger(self) -> socket.socket:
        """A connection that says nothing."""
        self._strangers.append(connection(self.sockets.endpoint))
        return self._strangers[-1]

    def dealer(self, question: bytes = b"question") -> "zmq.Socket[bytes]":
        """A connection with the key that asks for an answer."""
        made = self.socket(zmq.DEALER)
        made.connect(self.sockets.endpoint)
        made.send(question)
        return made

    def socket(self, kind: int) -> "zmq.Socket[bytes]":
        """With the key, not connected yet."""
        made = self.context.socket(kind)
        self._made.append(made)  # it lives until all are closed
        if self.keys is not None:
            made.curve_serverkey = self.keys.server.public.encode()
            made.curve_publickey = self.keys.player.public.encode()
            made.curve_secretkey = self.keys.player.secret.encode()
        return made

    def until(self, done: Callable[[], Any], limit_s: float = LIMIT_S) -> None:
        end = time.monotonic() + limit_s
        while not done():
            assert time.monotonic() < end, self.counters
            while self.sockets.wait(0.01) and (received := self.sockets.receive()):
                self.sockets.send(received[0], [b"answer"])

    def close(self) -> None:
        self.context.destroy(linger=0)
        for stranger in self._strangers:
            stranger.close()
        self.sockets.close()

    def answered(self, *dealers: "zmq.Socket[bytes]") -> None:
        self.until(lambda: all(d.poll(0) for d in dealers))
        assert [d.recv() for d in dealers] == [b"answer"] * len(dealers)


@contextmanager
def door(keys: Keys | None, room: Room = AMPLE, bind: str = "127.0.0.1") -> Iterator[Door]:
    made = Door(keys, room, bind)
    try:
        yield made
    finally:
        made.close()


def ended(stranger: socket.socket) -> bool:
    """Whether a connection was ended: that is all there is to read after the greeting."""
    stranger.setblocking(False)
    try:
        while stranger.recv(4096):
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        pass
    return True


@pytest.mark.cluster
def test_of_too_many_without_a_key_the_oldest_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever has shown one stays, older or not, and others still get in."""
    monkeypatch.setattr("master.hub.gate.HANDSHAKES", 3)
    monkeypatch.setattr("master.hub.gate.MOVING_S", 0.0)
    with door(make_keys()) as made:
        first = made.dealer()
        made.answered(first)
        strangers = []
        for _ in range(6):
            strangers.append(made.stranger())
            made.until(lambda: made.counters["refused_handshakes"] >= len(strangers) - 3)
        made.until(lambda: all(ended(s) for s in strangers[:3]))
        assert not any(ended(s) for s in strangers[3:])
        second = made.dealer()
        first.send(b"question")
        made.answered(first, second)
        assert made.counters["refused_handshakes"] == 4


@pytest.mark.cluster
def test_a_welcome_or_an_error_before_the_key_lets_nobody_in() -> None:
    """Else 32 that stopped there would keep all others out."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()),
        server.accept()[0] as made,
    ):
        found, total = dict[int, bool](), 0
        for more in (64, 170, 12, 4):  # greeting, WELCOME, an error or instead of it READY
            made.sendall(bytes(more))
            total += more
            found[total] = _let_in(made)
    assert found == {64: False, 234: False, 246: False, LET_IN: True}


@pytest.mark.cluster
def test_where_keys_are_shown_one_after_the_other_the_newest_goes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else workers that start together would end each other before any has shown its key."""
    monkeypatch.setattr("master.hub.gate.HANDSHAKES", 3)
    monkeypatch.setattr("master.hub.gate.MOVING_S", 3600.0)
    with door(make_keys()) as made:
        made.answered(made.dealer())
        strangers = [made.stranger() for _ in range(6)]
        made.until(lambda: all(ended(s) for s in strangers[3:]))
        assert not any(ended(s) for s in strangers[:3])


@pytest.mark.cluster
def test_the_largest_frame_fits_encrypted_too() -> None:
    with door(make_keys()) as made:
        made.answered(made.dealer(bytes(MAX_FRAME_BYTES)))


@pytest.mark.cluster
@pytest.mark.parametrize("encrypted", [True, False])
def test_a_long_subscription_ends_its_connection(encrypted: bool) -> None:
    with door(make_keys() if encrypted else None) as made:
        plain, long = made.socket(zmq.SUB), made.socket(zmq.SUB)
        for one, topic in ((long, bytes(MAX_COMMAND)), (plain, b"")):
            one.subscribe(topic)
            events = one.get_monitor_socket(zmq.EVENT_DISCONNECTED)
            one.connect(made.sockets.weights_endpoint)
            if one is long:
                made.until(lambda events=events: events.poll(0))

        def heard() -> int:
            made.sockets.publish(b"weights")
            return plain.poll(1)

        made.until(heard)


@pytest.mark.cluster
def test_a_handshake_has_little_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master.hub.sockets.HANDSHAKE_MS", 100)
    with door(make_keys()) as made:
        idle = made.stranger()
        made.until(lambda: ended(idle), limit_s=25.0)  # 30 s is ZeroMQ's own
        assert not made.counters["refused_handshakes"]


@pytest.fixture(params=["tcp", "unix"])
def bind(request: pytest.FixtureRequest) -> Iterator[str]:
    with TemporaryDirectory(dir="/tmp") as folder:  # paths of sockets are short
        yield "127.0.0.1" if request.param == "tcp" else f"ipc://{folder}/run"


@pytest.mark.cluster
def test_one_connection_too_many_is_ended_and_the_others_stay(bind: str) -> None:
    with door(None, Room(RESERVE + 3), bind) as made:
        first = made.dealer()
        made.answered(first)
        strangers = [made.stranger(), made.stranger()]
        more = made.stranger()
        made.until(lambda: ended(more))
        assert not any(ended(s) for s in strangers)
        first.send(b"question")
        made.answered(first)
        assert made.counters["refused_connections"] == 1
        strangers.pop().close()  # which makes room
        made.answered(made.dealer())


@pytest.mark.cluster
def test_it_is_told_from_where_a_message_came(bind: str) -> None:
    with door(None, bind=bind) as made:
        made.dealer()
        assert made.sockets.wait(LIMIT_S)
        received = made.sockets.receive()
        assert received is not None
        unix = bind.startswith("ipc")
        assert received.address == (f"local, pid {os.getpid()}" if unix else "127.0.0.1")


@pytest.mark.cluster
def test_a_number_that_is_anothers_connection_by_now_is_left_alone() -> None:
    """ZeroMQ tells the number of a descriptor, which may be closed and used again meanwhile."""
    with (
        door(make_keys()) as made,
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as near,
        server.accept()[0] as far,
    ):
        gate = made.sockets._gate
        assert gate is not None
        for number in (far.fileno(), near.fileno(), server.fileno(), 10**6):
            gate._accepted((None, number))
            gate._end((None, number), "refused_handshakes", "")
        near.sendall(b"still there")
        assert far.recv(100) == b"still there"
        assert not made.counters


@pytest.mark.cluster
def test_a_number_that_is_another_connection_by_now_is_left_alone() -> None:
    with door(make_keys()) as made:
        stranger, gate = made.stranger(), made.sockets._gate
        assert gate is not None
        made.until(lambda: gate._waiting)
        [number] = gate._waiting
        gate._waiting[number] = "127.0.0.1:1"  # of the connection that had the number before
        gate._end(number, "refused_handshakes", "")
        assert not ended(stranger)
        assert not made.counters


@pytest.mark.cluster
def test_an_end_that_is_told_late_is_not_that_of_another_socket_with_the_number() -> None:
    """Subscribers of a revoked key went on, as nobody knew of their connections any more."""
    with door(make_keys()) as made:
        made.stranger()
        gate = made.sockets._gate
        assert gate is not None
        made.until(lambda: gate._waiting)
        [(monitor, number)] = gate._waiting
        [other] = {*gate._monitors} - {monitor}
        gate._handle(other, EVENT.pack(zmq.EVENT_DISCONNECTED, number))
        assert [*gate._open] == [*gate._waiting] == [(monitor, number)]


@pytest.mark.cluster
def test_all_are_ended_of_whom_the_gate_has_not_heard_yet_and_the_socket_listens_on() -> None:
    """A subscriber of a revoked key stayed, as its connection was told late."""
    with door(make_keys()) as made:
        stranger, gate = made.stranger(), made.sockets._gate
        assert gate is not None
        made.until(lambda: gate._open)
        gate._open.clear()
        gate.end_all(made.sockets.weights_endpoint)
        assert not ended(stranger)
        gate.end_all(made.sockets.endpoint)
        made.until(lambda: ended(stranger))
        made.answered(made.dealer())


@pytest.mark.cluster
def test_connections_end_also_where_no_descriptor_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flood had taken all: the master failed, and a revoked key went on hearing."""

    def no_room(*_: object) -> int:
        raise OSError(errno.EMFILE, "Too many open files")

    with door(make_keys()) as made:
        stranger, gate = made.stranger(), made.sockets._gate
        assert gate is not None
        made.until(lambda: gate._open)
        with monkeypatch.context() as patch:
            for name in ("dup", "open", "listdir", "scandir"):
                patch.setattr(os, name, no_room)
            gate.end_all(made.sockets.endpoint)
        made.until(lambda: ended(stranger))


@pytest.mark.fast
def test_a_number_that_is_a_file_by_now_leaves_all_as_it_was(tmp_path: Path) -> None:
    """Strangers who came and went in a flood left the master without descriptors."""
    descriptors = Path("/proc/self/fd")
    with (tmp_path / "file").open("w") as file:
        before = len([*descriptors.iterdir()])
        for _ in range(3):
            with pytest.raises(OSError, match="non-socket"), _connection(file.fileno()):
                pass
        assert len([*descriptors.iterdir()]) == before
        assert not os.fstat(file.fileno()).st_size


@pytest.mark.cluster
def test_200_at_once_are_all_let_in() -> None:
    """Those who are ended in their handshake come again by themselves."""
    with door(make_keys()) as made:
        dealers = [made.dealer() for _ in range(200)]
        waiting = set(dealers)

        def asked() -> bool:
            waiting.difference_update([d for d in waiting if d.poll(0)])
            return not waiting

        made.until(asked)
