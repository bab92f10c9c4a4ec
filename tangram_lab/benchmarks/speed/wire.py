"""The way from worker to master: a Client and a Hub, against bare ROUTER-DEALER sockets.

Both carry the same frames between two processes, with as many unacknowledged, over a unix socket or
over TCP on this machine. What is counted are the transitions that the master's end takes. Ours are
checked on both ends, decoded, entered into the table of duplicates and acknowledged; the bare ones
are received, and answered with as many bytes.
"""

import json
import multiprocessing
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from socket import gethostname
from typing import Any

import zmq

from master.hub.admission import WelcomeInfo
from master.hub.hub import Hub
from master.hub.security import Keys, make_keys
from master.record.delivery import EpisodesArrived
from tangram_core.errors import TangramError
from tangram_core.setup import Setup
from tangram_core.spec import Episodes
from tangram_core.wire.addresses import IPC
from tangram_core.wire.messages import WINDOW, Ack, EpisodeBatch
from tangram_lab.benchmarks.measure import Bound, Row, Work, compared, rates, single
from tangram_lab.benchmarks.setups import played, several
from worker.talk.client import Client
from worker.talk.connection import Timing

STAGE, UNIT = "wire", "transitions/s"
SHARE = Bound(least=0.6)
FLOOR = Bound(least=500_000)
SPAN_S = 1.0
BARE_MESSAGES = 16  # between two looks at the clock
PATIENCE_S = 20.0
SEQUENCE = 1000  # of the bare batches: its header is as long as most
UNIX, PLAIN, CURVE = "unix", "plain", "curve"


@dataclass(frozen=True)
class Case:
    """What is sent.

    Attributes:
        text: for the row.
        tans: tokens of an episode, 1 or 7.
        batch: episodes in a message.
        way: a unix socket, TCP, or TCP with keys.
    """

    text: str
    tans: int
    batch: int
    way: str

    @property
    def keys(self) -> Keys | None:
        """For encrypted sockets."""
        return make_keys() if self.way == CURVE else None


LARGE = Case("1 token, 256 in a batch, unix", 1, 256, UNIX)
CASES = (
    LARGE,
    Case("1 token, 256 in a batch, plain", 1, 256, PLAIN),
    Case("1 token, 256 in a batch, curve", 1, 256, CURVE),
    Case("1 token, 32 in a batch, unix", 1, 32, UNIX),
    Case("7 tokens, 32 in a batch, unix", 7, 32, UNIX),
)


def measure_wire(runs: int) -> list[Row]:
    """All cases, ours and bare in turns."""
    return [row for case in CASES for row in _measure(case, runs)]


def _measure(case: Case, runs: int) -> Iterator[Row]:
    setup = several(case.tans)
    episodes = played(setup, case.batch)
    with ours(case, setup, episodes) as mine, bare(case, setup, episodes) as theirs:
        found = rates({"ours": mine, "theirs": theirs}, runs, SPAN_S)
    labels = (STAGE, case.text, UNIT)
    yield compared(labels, found["ours"], "bare ROUTER-DEALER", found["theirs"], SHARE)
    if case is LARGE:
        yield single((STAGE, f"{case.text}, decoded and checked", UNIT), found["ours"], FLOOR)


@contextmanager
def child(target: Callable[..., None], *arguments: Any) -> Iterator[None]:
    """A process that runs a function, and is ended at the end."""
    process = multiprocessing.get_context("spawn").Process(
        target=target, args=arguments, daemon=True
    )
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


# Ours


@contextmanager
def ours(case: Case, setup: Setup, episodes: Episodes) -> Iterator[Work]:
    """A Hub here that takes what a Client in another process sends."""
    info = WelcomeInfo("bench", 0, setup.fingerprints(), setup.spec, window=WINDOW)
    with tempfile.TemporaryDirectory() as folder:
        bind = f"{IPC}{folder}/hub" if case.way == UNIX else "127.0.0.1"
        with Hub(bind, 0, info, keys=case.keys) as hub:
            connect = Path(folder) / "connection.json"
            connect.write_text(json.dumps(_connection(hub, hub.keys)))
            with child(send_batches, str(connect), setup, episodes):
                yield lambda: take_batches(hub)


def take_batches(hub: Hub) -> int:
    """Take what has come, and acknowledge it; returns its transitions."""
    arrivals = [a for a in hub.poll(PATIENCE_S) if isinstance(a, EpisodesArrived)]
    for arrival in arrivals:
        hub.acknowledge(arrival)
    return sum(arrival.episodes.transitions for arrival in arrivals)


def send_batches(connect: str, setup: Setup, episodes: Episodes) -> None:
    """Send the same batch for ever; runs in a process of its own."""
    timing, prints = Timing(lost_s=PATIENCE_S), setup.fingerprints()
    with Client(connect, "player", 0, prints, setup.spec, window=WINDOW, timing=timing) as client:
        if not client.join():
            raise TangramError("the hub does not let the player in")
        while client.send(episodes, 0):
            pass


def _connection(hub: Hub, keys: Keys | None) -> dict[str, Any]:
    where = {"endpoint": hub.endpoint, "run_id": "bench", "machine": gethostname()}
    if keys is None:
        return where
    return where | {"server_key": keys.server.public, "keys": {"player": asdict(keys.player)}}


# Theirs


@contextmanager
def bare(case: Case, setup: Setup, episodes: Episodes) -> Iterator[Work]:
    """A ROUTER here that takes and answers what a DEALER in another process sends."""
    frames = EpisodeBatch(SEQUENCE, 0, episodes).encode(setup.spec)
    ack, keys = Ack(SEQUENCE, duplicate=False).encode()[0], case.keys
    with (
        tempfile.TemporaryDirectory() as folder,
        zmq.Context() as context,
        context.socket(zmq.ROUTER) as router,
    ):
        router.setsockopt(zmq.RCVTIMEO, round(PATIENCE_S * 1000))
        if keys is not None:
            router.setsockopt(zmq.CURVE_SERVER, 1)
            router.setsockopt(zmq.CURVE_SECRETKEY, keys.server.secret.encode())
        router.bind(f"{IPC}{folder}/bare" if case.way == UNIX else "tcp://127.0.0.1:*")
        endpoint = router.getsockopt_string(zmq.LAST_ENDPOINT)
        with child(send_frames, endpoint, frames, keys):
            yield lambda: _take_frames(router, ack) * episodes.transitions


def _take_frames(router: "zmq.Socket[bytes]", ack: bytes) -> int:
    for _ in range(BARE_MESSAGES):
        router.send_multipart([router.recv_multipart()[0], ack])
    return BARE_MESSAGES


def send_frames(endpoint: str, frames: list[bytes], keys: Keys | None) -> None:
    """Send the same frames for ever, and wait for an answer when a window of them is on its way."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.LINGER, 0)
        dealer.setsockopt(zmq.RCVTIMEO, round(PATIENCE_S * 1000))
        if keys is not None:
            dealer.setsockopt(zmq.CURVE_SERVERKEY, keys.server.public.encode())
            dealer.setsockopt(zmq.CURVE_PUBLICKEY, keys.player.public.encode())
            dealer.setsockopt(zmq.CURVE_SECRETKEY, keys.player.secret.encode())
        dealer.connect(endpoint)
        for _ in range(WINDOW - 1):
            dealer.send_multipart(frames)
        while True:
            dealer.send_multipart(frames)
            dealer.recv_multipart()
