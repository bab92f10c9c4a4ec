"""The master's sockets as a stranger sees them."""

import socket
import struct
import subprocess
import sys
import tempfile
import time

import pytest

from master.hub.gate import _connection
from master.hub.sockets import Sockets
from master.record.counters import Counters
from tangram_core.wire.addresses import DEAD_S, IPC, PROBE_S

pytestmark = pytest.mark.cluster

# ZMTP 3.1 (https://rfc.zeromq.org/spec/37): signature, version, mechanism, not as a server.
GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x05READY" + b"\x0bSocket-Type" + b"\0\0\0\x06DEALER"
COMMAND = b"\x04"


def connected(endpoint: str) -> socket.socket:
    """A DEALER that has shaken hands."""
    if endpoint.startswith(IPC):
        peer = socket.socket(socket.AF_UNIX)
        peer.connect(endpoint.removeprefix(IPC))
    else:
        peer = socket.create_connection(("127.0.0.1", int(endpoint.rpartition(":")[2])))
    peer.settimeout(10)
    peer.sendall(GREETING + COMMAND + bytes([len(READY)]) + READY)
    heard = b""
    while b"ROUTER" not in heard:
        part = peer.recv(1024)
        assert part, "the connection was closed"
        heard += part
    return peer


def test_a_connection_that_died_without_a_word_is_found() -> None:
    """It would stay open, and its queue with it."""
    wanted = {
        (socket.SOL_SOCKET, socket.SO_KEEPALIVE): 1,
        (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE): PROBE_S,
        (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL): PROBE_S,
        (socket.IPPROTO_TCP, socket.TCP_KEEPCNT): DEAD_S // PROBE_S - 1,
        (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT): DEAD_S * 1000,
    }
    sockets = Sockets("127.0.0.1", 0, Counters())
    try:
        with connected(sockets.endpoint):
            gate, end = sockets._gate, time.monotonic() + 10
            assert gate is not None
            while not gate._open and time.monotonic() < end:
                time.sleep(0.01)
            [(_, descriptor)] = gate._open
            with _connection(descriptor) as found:
                assert {option: found.getsockopt(*option) for option in wanted} == wanted
    finally:
        sockets.close()


# Two masters that do not read for a while, as while one learns; their pings would come after 5 s.
BUSY = """
import sys, time
from master.record.counters import Counters
from master.hub.sockets import Sockets
made = [Sockets(bind, 0, Counters()) for bind in ("127.0.0.1", sys.argv[1])]
print(*(one.endpoint for one in made), flush=True)
sys.stdin.readline()
time.sleep(5.5)
for one in made:
    while one.wait(0.1):
        one.receive()
    one.close()
"""


def test_who_is_gone_while_its_queue_is_full_ends_nobody() -> None:
    """ZeroMQ aborts the process that pings such a connection."""
    with (
        tempfile.TemporaryDirectory(dir="/tmp") as folder,  # paths of sockets are short
        subprocess.Popen(
            [sys.executable, "-c", BUSY, f"ipc://{folder}/m"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        ) as process,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        for endpoint in process.stdout.readline().decode().split():
            with connected(endpoint) as peer:
                if peer.family != socket.AF_UNIX:  # it ends with a reset
                    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                peer.sendall(b"\0\x01x" * 1000)
        process.stdin.close()
        assert process.wait(60) == 0
