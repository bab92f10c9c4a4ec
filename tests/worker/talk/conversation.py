"""Both ends of the conversation: real clients, a real hub, and a master that says what it is told.

`staged` hubs (tests/master/hub/dealers.py) are served by the test's own thread; `with_master`
serves a hub from another one, because signals belong to the main thread.
"""

import json
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import zmq

from master.hub.admission import WelcomeInfo
from master.hub.hub import Hub
from master.record.delivery import Arrival
from tangram_core.setup import Setup
from tangram_core.wire.messages import (
    EpisodeBatch,
    Heartbeat,
    Hello,
    ToMaster,
    WantWeights,
    Welcome,
    decode_from_worker,
)
from tangram_core.wire.schema import Message
from tests.agent.builders import with_bound
from tests.agent.messages import FINGERPRINTS, SPEC
from tests.master.hub.dealers import Stage
from worker.talk.client import Client
from worker.talk.connection import Timing

Kind = TypeVar("Kind")
Result = TypeVar("Result")

LIMIT_S = 100.0
# What a test does not wait for comes too late for it: after LIMIT_S.
QUICK = Timing(
    join_s=3600.0, retry_s=0.05, heartbeat_s=0.05, resend_s=3600.0, silence_s=3600.0, lost_s=36000.0
)


def make_client(connect: object, timing: Timing = QUICK, **more: Any) -> Client:
    fields: dict[str, Any] = {"role": "player", "index": -1, "fingerprints": FINGERPRINTS} | more
    return Client(str(connect), spec=SPEC, timing=timing, **fields)


def served(stage: Stage, call: Callable[[], Result]) -> Result:
    """What a call that waits returns, while the hub is served."""
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(call)
        stage.until(future.done)
        return future.result()


@contextmanager
def joined(stage: Stage, **more: Any) -> Iterator[Client]:
    with make_client(stage.hub.endpoint, **more) as client:
        assert served(stage, client.join)
        yield client


@contextmanager
def welcomed(master: "StandIn", timing: Timing = QUICK, **more: Any) -> Iterator[Client]:
    with make_client(master.endpoint, timing, **more) as client:
        master.welcome(client)
        yield client


def both(stage: Stage, client: Client, done: Callable[[], Any]) -> None:
    """Serve the hub and let the client work until something holds."""

    def step() -> Any:
        client.poll()
        return done()

    stage.until(step)


def write_connection(folder: Path, endpoint: str, run_id: str = "run", machine: str = "") -> Path:
    """As a master writes it, of this machine unless another is named."""
    aside = folder / "aside"
    content = {"endpoint": endpoint, "run_id": run_id, "machine": machine or socket.gethostname()}
    aside.write_text(json.dumps(content))
    return aside.replace(folder / "connection.json")


def numbers(heard: list[ToMaster]) -> list[int]:
    return [message.sequence for message in heard if isinstance(message, EpisodeBatch)]


class StandIn:
    """A ROUTER with a PUB; keeps what it heard.

    Attributes:
        endpoint: of the ROUTER.
        heard: messages but heartbeats.
        stats: of the last heartbeat.
        identity: of the connection that was heard last.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], port: int | str = "*") -> None:
        self._router, self._pub = context.socket(zmq.ROUTER), context.socket(zmq.PUB)
        for one, its_port in ((self._router, port), (self._pub, "*")):
            one.bind(f"tcp://127.0.0.1:{its_port}")
        self.endpoint = self._router.getsockopt_string(zmq.LAST_ENDPOINT)
        self.heard: list[ToMaster] = []
        self.stats: Mapping[str, float] = {}
        self.identity = b""

    def listen(self) -> ToMaster | None:
        """The next message, if there is one."""
        if not self._router.poll(5):
            return None
        self.identity, *frames = self._router.recv_multipart()
        message = decode_from_worker(frames, SPEC)
        if isinstance(message, Heartbeat):
            self.stats = message.stats
        else:
            self.heard.append(message)
        return message

    def until_heartbeat(self) -> None:
        """Listen, while the client does nothing, until it was heard to live."""
        deadline = time.monotonic() + LIMIT_S
        while not isinstance(self.listen(), Heartbeat):
            if time.monotonic() > deadline:
                raise TimeoutError("no heartbeat came")

    def say(self, *messages: Message | list[bytes]) -> None:
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

    def await_kind(self, client: Client, kind: type[Kind]) -> Kind:
        """The next message of this kind."""
        count = len(self.heard)

        def found() -> list[Kind]:
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
def standing_in(port: int | str = "*") -> Iterator[StandIn]:
    """A stand-in that nobody has connected to."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        yield StandIn(context, port)
    finally:
        context.destroy(linger=0)


# A hub in a thread of its own


def open_hub(made: Setup, window: int = 4, seed: int = 11, lockstep: bool = False) -> Hub:
    """A master's hub on a free port."""
    spec = with_bound(made.spec, 100.0)
    names = frozenset(score.name for score in made.task.scores)
    info = WelcomeInfo("run", seed, made.fingerprints(), spec, window, lockstep, names)
    return Hub("127.0.0.1", 0, info)


def collect(hub: Hub, enough: Callable[[list[Arrival]], bool]) -> list[Arrival]:
    """Poll until there is enough."""
    arrivals: list[Arrival] = []
    deadline = time.monotonic() + LIMIT_S
    while not enough(arrivals):
        if time.monotonic() > deadline:
            raise TimeoutError(f"{len(arrivals)} arrivals, {dict(hub.counters)}")
        arrivals += hub.poll(0.05)
    return arrivals


def with_master(
    hub: Hub, script: Callable[[Hub], Result], worker: Callable[[], int]
) -> tuple[Result, int]:
    """Run a worker in this thread while the script serves the hub in another, then stop both."""

    def serve() -> Result:
        try:
            return script(hub)
        finally:
            hub.stop("the script is over")
            collect(hub, lambda _: not hub.peers)

    with hub, ThreadPoolExecutor(1) as pool:
        result = pool.submit(serve)
        status = worker()
        return result.result(LIMIT_S), status
