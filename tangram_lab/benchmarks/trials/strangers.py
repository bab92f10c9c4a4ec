"""Connections without a key, as many and as expensive to the master as possible."""

import selectors
import socket
import struct
from contextlib import suppress
from typing import Self
from urllib.parse import urlsplit

# Greeting of ZMTP 3.1 (https://rfc.zeromq.org/spec/37): signature, version, mechanism, as a client.
SIGNATURE = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x01"
CURVE, NULL = (SIGNATURE + name.ljust(20, b"\0") + bytes(32) for name in (b"CURVE", b"NULL"))
READY = b"\x04\x19\x05READY" + b"\x0bSocket-Type" + b"\0\0\0\x03SUB"
LARGE, LARGE_COMMAND = b"\x02", b"\x06"
SIZE = struct.Struct(">Q")
AT_ONCE = 16  # connections opened by one `push`


def connection(endpoint: str) -> socket.socket:
    """A raw socket connected to an ipc or tcp endpoint."""
    if endpoint.startswith("ipc://"):
        one = socket.socket(socket.AF_UNIX)
        one.connect(endpoint.removeprefix("ipc://"))
        return one
    place = urlsplit(endpoint)
    return socket.create_connection((place.hostname or "", place.port or 0))


def subscribe(endpoint: str, size: int) -> None:
    """Subscribe to a topic of `size` bytes without keys, and wait until the master closes."""
    with connection(endpoint) as one, suppress(TimeoutError, ConnectionError):
        one.sendall(NULL + READY + LARGE + SIZE.pack(1 + size) + b"\x01" + bytes(size))
        one.settimeout(1.0)
        while one.recv(4096):
            pass


class Strangers:
    """Many open connections; each one that the master closes is replaced.

    Attributes:
        opened: number of connections opened so far.
        ended: number of connections that have ended.
    """

    def __init__(self, endpoint: str, count: int, size: int = 0) -> None:
        """Open no connection yet; `push` does.

        Args:
            endpoint: TCP address of an encrypted socket.
            count: number of connections at a time.
            size: bytes of a frame that each connection sends except the last byte; 0: send nothing.
        """
        self._endpoint, self._count = endpoint, count
        frame = LARGE_COMMAND + SIZE.pack(size) + bytes(size - 1) if size else b""
        self._words = CURVE + frame if size else b""
        self._selector = selectors.DefaultSelector()
        self.opened = self.ended = 0

    @property
    def connected(self) -> int:
        """Number of open connections."""
        return self.opened - self.ended

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for key in list(self._selector.get_map().values()):
            self._drop(key)
        self._selector.close()

    def push(self) -> None:
        """Open some missing connections, and send as much as the master accepts."""
        for _ in range(min(AT_ONCE, self._count - self.connected)):
            self._connect()
        for key, events in self._selector.select(0):
            try:
                self._serve(key, events)
            except BlockingIOError:
                continue
            except OSError:
                self._drop(key)

    def _connect(self) -> None:
        one = connection(self._endpoint)
        one.setblocking(False)
        both = selectors.EVENT_READ | selectors.EVENT_WRITE
        self._selector.register(one, both, memoryview(self._words))
        self.opened += 1

    def _serve(self, key: selectors.SelectorKey, events: int) -> None:
        one, words = key.fileobj, key.data
        assert isinstance(one, socket.socket)
        if events & selectors.EVENT_READ and not one.recv(4096):
            raise ConnectionResetError
        if events & selectors.EVENT_WRITE:
            words = words[one.send(words) :] if words else words
            events = selectors.EVENT_READ | (selectors.EVENT_WRITE if words else 0)
            self._selector.modify(one, events, words)

    def _drop(self, key: selectors.SelectorKey) -> None:
        assert isinstance(key.fileobj, socket.socket)
        self._selector.unregister(key.fileobj)
        key.fileobj.close()
        self.ended += 1
