"""A TCP proxy that can drop the data of one direction or of both."""

import selectors
import socket
from threading import Event, Thread
from typing import Self

CHUNK = 65536
UP, DOWN = "up", "down"  # to the master, from the master


class Proxy:
    """Forwards connections to the port `target` of this machine; `cut` drops their data.

    Attributes:
        port: the port that clients connect to.
    """

    def __init__(self, target: int) -> None:
        self._target, self._cut = target, frozenset[str]()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._ends = Event()
        self._thread = Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join()
        for key in list(self._selector.get_map().values()):
            key.fileobj.close()  # type: ignore[union-attr]
        self._selector.close()

    def cut(self, *directions: str) -> None:
        """Drop the data of these directions from now on; without arguments, forward all again."""
        self._cut = frozenset(directions)

    def _serve(self) -> None:
        while not self._ends.is_set():
            for key, _ in self._selector.select(0.05):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._forward(key)

    def _accept(self) -> None:
        near, _ = self._listener.accept()
        try:
            far = socket.create_connection(("127.0.0.1", self._target))
        except OSError:
            near.close()
            return
        self._selector.register(near, selectors.EVENT_READ, (UP, far))
        self._selector.register(far, selectors.EVENT_READ, (DOWN, near))

    def _forward(self, key: selectors.SelectorKey) -> None:
        direction, other = key.data
        source = key.fileobj
        assert isinstance(source, socket.socket)
        try:
            data = source.recv(CHUNK)
            if data and direction not in self._cut:
                other.sendall(data)
        except OSError:
            data = b""
        if not data:
            for end in (source, other):
                if end.fileno() >= 0:
                    self._selector.unregister(end)
                    end.close()
