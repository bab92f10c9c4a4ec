"""Connections of those who have no key, as many and as expensive as they can be."""

import selectors
import socket
import struct
from typing import Self
from urllib.parse import urlsplit

# ZMTP 3.1 (https://rfc.zeromq.org/spec/37): signature, version, mechanism, not as a server.
GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x01" + b"CURVE".ljust(20, b"\0") + bytes(32)
LARGE_COMMAND = b"\x06"
AT_ONCE = 16  # connections that are opened between two looks at the others


class Strangers:
    """So many connections; where one is ended another takes its place.

    Attributes:
        opened: connections so far.
        ended: of them, by the other side.
    """

    def __init__(self, endpoint: str, count: int, size: int = 0) -> None:
        """Nobody is there yet.

        Args:
            endpoint: on TCP, of an encrypted socket.
            count: connections at a time.
            size: of a frame that each sends but for its last byte, 0 for silence.
        """
        place = urlsplit(endpoint)
        self._address, self._count = (place.hostname or "", place.port or 0), count
        frame = LARGE_COMMAND + struct.pack(">Q", size) + bytes(size - 1) if size else b""
        self._words = GREETING + frame if size else b""
        self._selector = selectors.DefaultSelector()
        self.opened = self.ended = 0

    @property
    def connected(self) -> int:
        """How many are."""
        return self.opened - self.ended

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for key in list(self._selector.get_map().values()):
            self._drop(key)
        self._selector.close()

    def push(self) -> None:
        """Connect those who are missing, and send what is taken."""
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
        one = socket.create_connection(self._address)
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
