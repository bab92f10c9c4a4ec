"""A hub and peers that say what they are told to, on real sockets, in one thread."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zmq

from master.delivery import Arrival, EpisodesArrived
from master.hub import Hub, WelcomeInfo
from tangram_agent.messages import ToWorker, Welcome, decode_from_master
from tests.agent.messages import FINGERPRINTS, SPEC, batch, hello

LIMIT_S = 20.0
WINDOW = 3
INFO = WelcomeInfo("run", 7, FINGERPRINTS, SPEC, WINDOW)


class Stage:
    """A hub whose arrivals are kept.

    Attributes:
        hub: under test.
        arrivals: all of them, in order.
    """

    def __init__(self, hub: Hub) -> None:
        self.hub = hub
        self.arrivals: list[Arrival] = []
        self._dealers: list[Dealer] = []
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()

    def dealer(self) -> "Dealer":
        """Another connection."""
        made = Dealer(self, self._context.socket(zmq.DEALER))
        self._dealers.append(made)
        return made

    def subscriber(self) -> zmq.Socket[bytes]:
        """A connection to the broadcasts."""
        socket = self._context.socket(zmq.SUB)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        socket.connect(self.hub.weights_endpoint)
        return socket

    def until(self, done: Callable[[], Any]) -> None:
        """Serve the hub until something holds, within a limit."""
        self.until_within(LIMIT_S, done)

    def until_within(self, limit_s: float, done: Callable[[], Any]) -> None:
        """Serve the hub until something holds; TimeoutError when the time is over before."""
        deadline = time.monotonic() + limit_s
        while not done():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{dict(self.hub.counters)}")
            self.arrivals += self.hub.poll(0.01)

    def counted(self, name: str, count: int = 1) -> None:
        """Serve the hub until a counter is there."""
        self.until(lambda: self.hub.counters[name] >= count)
        assert self.hub.counters[name] == count

    def batches(self) -> list[EpisodesArrived]:
        """Batches that arrived."""
        return [a for a in self.arrivals if isinstance(a, EpisodesArrived)]

    def close(self) -> None:
        """Drop all connections."""
        self._context.destroy(linger=0)


class Dealer:
    """A connection that says what it is told to."""

    def __init__(self, stage: Stage, socket: zmq.Socket[bytes]) -> None:
        self.stage, self.socket = stage, socket
        socket.connect(stage.hub.endpoint)

    def say(self, frames: list[bytes]) -> None:
        """Send a message."""
        self.socket.send_multipart(frames)

    def send(self, *sequences: int) -> None:
        """Send batches with these numbers."""
        for sequence in sequences:
            self.say(batch(sequence).encode(SPEC))

    def hear(self) -> ToWorker:
        """The hub's next answer."""
        self.stage.until(lambda: self.socket.poll(0))
        return decode_from_master(self.socket.recv_multipart(), None)

    def join(self, **fields: Any) -> Welcome:
        """Say HELLO and be welcomed."""
        self.say(hello(**fields).encode())
        answer = self.hear()
        assert isinstance(answer, Welcome), answer
        return answer


@contextmanager
def staged(bind: str = "127.0.0.1", port: int = 0, **hub: Any) -> Iterator[Stage]:
    """A hub on a free port, with nobody connected yet."""
    with Hub(bind, port, INFO, **hub) as made:
        stage = Stage(made)
        try:
            yield stage
        finally:
            stage.close()
