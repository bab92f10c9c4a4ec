"""A master that says what it is told to, for what a real hub never does."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import zmq

from tangram_agent.messages import (
    Heartbeat,
    Hello,
    ToMaster,
    WantWeights,
    Welcome,
    decode_from_worker,
)
from tangram_agent.schema import Plain
from tests.agent.messages import FINGERPRINTS, SPEC
from worker.client import Client
from worker.connection import Timing

Message = TypeVar("Message")

LIMIT_S = 20.0
QUICK = Timing(
    join_s=10.0, retry_s=0.05, heartbeat_s=0.05, resend_s=30.0, silence_s=10.0, lost_s=30.0
)


def make_client(
    connect: str,
    timing: Timing = QUICK,
    index: int = -1,
    fingerprints: Mapping[str, str] = FINGERPRINTS,
    role: str = "player",
    **more: Any,
) -> Client:
    """A worker's client."""
    return Client(connect, role, index, fingerprints, SPEC, timing=timing, **more)


class StandIn:
    """A ROUTER with a PUB; keeps what it heard.

    Attributes:
        endpoint: of the ROUTER.
        heard: messages but heartbeats.
        identity: of the connection that was heard last.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._router, self._pub = context.socket(zmq.ROUTER), context.socket(zmq.PUB)
        for socket in (self._router, self._pub):
            socket.bind("tcp://127.0.0.1:*")
        self.endpoint = self._router.getsockopt_string(zmq.LAST_ENDPOINT)
        self.heard: list[ToMaster] = []
        self.identity = b""

    def listen(self) -> ToMaster | None:
        """The next message, if there is one."""
        if not self._router.poll(5):
            return None
        self.identity, *frames = self._router.recv_multipart()
        message = decode_from_worker(frames, SPEC)
        if not isinstance(message, Heartbeat):
            self.heard.append(message)
        return message

    def until_heartbeat(self) -> None:
        """Listen, while the client does nothing, until it was heard to live."""
        deadline = time.monotonic() + LIMIT_S
        while not isinstance(self.listen(), Heartbeat):
            if time.monotonic() > deadline:
                raise TimeoutError("no heartbeat came")

    def say(self, *messages: Plain | list[bytes]) -> None:
        """Answer the connection that was heard last."""
        for message in messages:
            frames = message if isinstance(message, list) else message.encode()
            self._router.send_multipart([self.identity, *frames])

    def broadcast(self, frame: bytes) -> None:
        """Send over PUB."""
        self._pub.send(frame)

    def until(self, client: Client, done: Callable[[], Any]) -> None:
        """Listen, and let the client work, until something holds."""
        deadline = time.monotonic() + LIMIT_S
        while not done():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{len(self.heard)} messages, the last {self.heard[-3:]}")
            client.poll(0.005)
            self.listen()

    def welcome(self, client: Client, **changes: Any) -> None:
        """Wait for the client's next HELLO, welcome it, and wait until it has understood."""
        self.await_kind(client, Hello)
        self.say(self.welcome_message(**changes))
        self.await_kind(client, WantWeights)

    def await_kind(self, client: Client, kind: type[Message]) -> Message:
        """The next message of this kind."""
        count = len(self.heard)

        def found() -> list[Message]:
            return [m for m in self.heard[count:] if isinstance(m, kind)]

        self.until(client, found)
        return found()[0]

    def welcome_message(self, **changes: Any) -> Welcome:
        """A WELCOME, the same for everybody."""
        fields = {
            "epoch": "e1",
            "run_id": "run",
            "seed": 7,
            "index": 3,
            "incarnation": 2,
            "weights_endpoint": self._pub.getsockopt_string(zmq.LAST_ENDPOINT),
            "window": 4,
            "lockstep": False,
        }
        return Welcome(**(fields | changes))


@contextmanager
def standing_in() -> Iterator[StandIn]:
    """A stand-in that nobody has connected to."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        yield StandIn(context)
    finally:
        context.destroy(linger=0)
