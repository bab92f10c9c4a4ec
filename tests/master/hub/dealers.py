"""A hub and peers that say what they are told to, on real sockets, in one thread."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zmq

from master.hub.admission import WelcomeInfo
from master.hub.hub import Hub
from master.record.delivery import Arrival, EpisodesArrived
from tangram_core.wire.arrays import WeightShapes
from tangram_core.wire.messages import Heartbeat, Reject, ToWorker, Welcome, decode_from_master
from tangram_core.wire.schema import Message
from tests.agent.messages import FINGERPRINTS, SPEC, TASK, batch, hello

LIMIT_S = 100.0
WINDOW = 3
NAMES = frozenset(score.name for score in TASK.task.scores)
INFO = WelcomeInfo("run", 7, FINGERPRINTS, SPEC, WINDOW, scores=NAMES)


class Stage:
    """A hub whose arrivals are kept.

    Attributes:
        hub: under test.
        arrivals: all of them, in order.
    """

    def __init__(self, hub: Hub) -> None:
        self.hub = hub
        self.arrivals: list[Arrival] = []
        self._sockets: list[zmq.Socket[bytes]] = []
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()

    def dealer(self, name: bytes = b"") -> "Dealer":
        """Another connection, perhaps with a name of its own choice."""
        socket = self._open(zmq.DEALER)
        if name:
            socket.setsockopt(zmq.IDENTITY, name)
        return Dealer(self, socket)

    def subscriber(self) -> zmq.Socket[bytes]:
        """A connection to the broadcasts."""
        socket = self._open(zmq.SUB)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        socket.connect(self.hub.weights_endpoint)
        return socket

    def _open(self, kind: int) -> zmq.Socket[bytes]:
        self._sockets.append(self._context.socket(kind))  # it lives until all are closed
        return self._sockets[-1]

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

    def say(self, message: Message | list[bytes]) -> None:
        self.socket.send_multipart(message if isinstance(message, list) else message.encode())

    def send(self, *sequences: int) -> None:
        """Send batches with these numbers."""
        for sequence in sequences:
            self.say(batch(sequence).encode(SPEC))

    def hear(self, shapes: WeightShapes | None = None) -> ToWorker:
        """The hub's next answer."""
        self.stage.until(lambda: self.socket.poll(0))
        return decode_from_master(self.socket.recv_multipart(), shapes)

    def ask(self, message: Message | list[bytes]) -> ToWorker:
        """Say something, and hear the next answer."""
        self.say(message)
        return self.hear()

    def beat(self) -> list[ToWorker]:
        """All the answers up to that to a heartbeat and those that come with it."""
        self.say(Heartbeat({}))
        self.say([b"no message"])
        answers: list[ToWorker] = []
        while not isinstance(answer := self.hear(), Reject):
            answers.append(answer)
        return answers

    def join(self, **fields: Any) -> Welcome:
        """Say HELLO and be welcomed."""
        answer = self.ask(hello(**fields))
        assert isinstance(answer, Welcome), answer
        return answer


@contextmanager
def staged(
    bind: str = "127.0.0.1", port: int = 0, info: WelcomeInfo = INFO, **hub: Any
) -> Iterator[Stage]:
    """A hub on a free port, with nobody connected yet."""
    with Hub(bind, port, info, **hub) as made:
        stage = Stage(made)
        try:
            yield stage
        finally:
            stage.close()
