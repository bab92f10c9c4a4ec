"""The master's sockets as a stranger on TCP sees them."""

import shutil
import socket
import tempfile
from pathlib import Path

import pytest

from master import sockets as sockets_module
from master.counters import Counters
from master.sockets import Sockets
from tests.agent.messages import weights
from tests.master.dealers import staged

pytestmark = pytest.mark.cluster

# ZMTP 3.1 (https://rfc.zeromq.org/spec/37): signature, version, mechanism, not as a server.
GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x05READY" + b"\x0bSocket-Type" + b"\0\0\0\x06DEALER"
COMMAND = b"\x04"


def test_a_peer_that_says_nothing_is_asked_whether_it_lives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A connection that died without a word would stay open, and its queue with it."""
    monkeypatch.setattr(sockets_module, "PING_MS", sockets_module.PING_MS // 50)
    sockets = Sockets("127.0.0.1", 0, Counters())
    try:
        port = int(sockets.endpoint.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=10) as peer:
            peer.sendall(GREETING + COMMAND + bytes([len(READY)]) + READY)
            heard = b""
            while b"\x04PING" not in heard:
                part = peer.recv(1024)
                assert part, "the connection was closed"
                heard += part
    finally:
        sockets.close()


@pytest.mark.parametrize("what", ["files", "folder", "folder taken"])
def test_who_comes_after_the_sockets_were_cleaned_away_joins(
    monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """It is told, and who was there before stays."""
    monkeypatch.setattr(sockets_module, "LOOK_S", 0.0)
    with tempfile.TemporaryDirectory() as short:  # a socket's path must be
        folder = Path(short) / "t"
        folder.mkdir(mode=0o700)
        with staged(f"ipc://{folder}/run") as stage:
            before = stage.dealer()
            before.join()
            shutil.rmtree(folder)
            if what == "files":
                folder.mkdir(mode=0o700)
            elif what == "folder taken":
                folder.touch()
                stage.until(lambda: stage.hub.counters["removed_sockets"] >= 2)
                folder.unlink()
            stage.until(lambda: len(list(folder.glob("run.*"))) == 2)
            assert stage.dealer().join(process="p2").index == 1
            news = stage.subscriber()

            def heard() -> int:
                stage.hub.publish(weights(version=stage.hub.counters["published"] + 1))
                return int(news.poll(10))

            stage.until(heard)
            assert before.join().index == 0
            if what != "folder taken":
                assert stage.hub.counters["removed_sockets"] == 2
        assert list(folder.iterdir()) == []
