"""Attacks on a training that listens on a port, with keys; each says whether it held and why.

Everything goes to 127.0.0.1 or to unix sockets of this machine, bounded in count and in time.
"""

import json
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import zmq

from master.admission import WelcomeInfo
from master.hub import Hub
from tangram_agent.arrays import MAX_FRAME_BYTES, EpisodeSpec
from tangram_agent.messages import EpisodeBatch, Heartbeat, Hello, Scores, WantWeights
from tangram_agent.schema import MAX_COUNT, seal
from tangram_agent.setup import Setup
from tangram_agent.types import Episodes
from tangram_lab.benchmarks.fuzz_wire import fuzzed, resealed, valid_messages
from tangram_lab.benchmarks.strangers import Strangers, subscribe
from tangram_lab.benchmarks.trainings import MIB, Watched, start_training, wait_for
from tangram_sim.errors import TangramError
from worker.client import Client
from worker.connection import Timing
from worker.discovery import find_master

Seen = tuple[bool, str]
ROOM_MIB = 64.0  # that the memory of a master may grow by under any attack
ENDS_S = 60.0
LOOK_S = 0.1
HOST = "127.0.0.1"


class Target(Watched):
    """A training under attack."""

    @contextmanager
    def peer(self, kind: int = zmq.DEALER, role: str = "player", **options: int) -> Iterator[Any]:
        """A socket with the keys of a role; of no role, without."""
        where, address = self.where, find_master(str(self.folder))
        with self.context.socket(kind) as one:
            one.setsockopt(zmq.LINGER, 0)
            if address is not None and role in address.keys:
                public, secret = address.keys[role]
                one.setsockopt(zmq.CURVE_SERVERKEY, address.server_key.encode())
                one.setsockopt(zmq.CURVE_PUBLICKEY, public.encode())
                one.setsockopt(zmq.CURVE_SECRETKEY, secret.encode())
            for name, value in options.items():
                one.setsockopt(getattr(zmq, name), value)
            one.connect(where["endpoint" if kind == zmq.DEALER else "weights_endpoint"])
            yield one

    def ask(self, *messages: list[bytes], role: str = "player") -> int:
        """How many answers a new connection gets to these messages."""
        answers = 0
        with self.peer(role=role) as one:
            for frames in messages:
                one.send_multipart(frames)
            while answers < len(messages) and one.poll(2000):
                one.recv_multipart()
                answers += 1
        return answers

    def port(self, name: str) -> tuple[str, int]:
        """Where something listens, as its connection file has it."""
        return HOST, urlsplit(self.where[name]).port or 0

    def hello(self, **fields: object) -> list[bytes]:
        """A HELLO of a player, with fields that no worker would send."""
        own: dict[str, object] = {"role": "player", "index": 3000, "incarnation": 0}
        own |= {"process": "attacker", "first": 1, "fingerprints": self.setup.fingerprints()}
        return seal(Hello.kind, {**own, "run_id": self.where["run_id"], **fields}, [])

    def cheap(self, deed: Callable[[], object], room_mib: float = ROOM_MIB) -> Seen:
        """Whether a deed costs little memory, and the same master goes on."""
        pid = self.master.pid
        with self.cost() as most:
            deed()
        same = self.goes_on() and self.master.pid == pid
        seen = f"+{most[0]:.0f} of {room_mib:g} MiB, the master {'goes on' if same else 'is gone'}"
        return same and most[0] <= room_mib, seen


@contextmanager
def training(folder: Path, *settings: str, name: str = "train") -> Iterator[Target]:
    """A training until the end of the block, which ends it in order."""
    launcher = start_training(folder, *settings, name=name)
    try:
        wait_for(folder / "connection.json", launcher)
        with zmq.Context() as context:
            context.set(zmq.MAX_SOCKETS, 4096)
            yield Target(folder, launcher, context)
            launcher.terminate()
            launcher.wait(ENDS_S)
    finally:
        launcher.kill()


def lasting(seconds: float, step: Callable[[], object], pause_s: float = 0.001) -> None:
    """Do something again and again for so long."""
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        step()
        time.sleep(pause_s)


def episodes_of(setup: Setup, count: int) -> Episodes:
    """Episodes of the right shapes; nobody has played them."""
    dice = np.random.default_rng(0)
    return Episodes(
        **{
            one.name: dice.uniform(0.0, 0.4, one.shape).astype(one.dtype)
            for one in EpisodeSpec.of(setup).columns(count)
        }
    )


# Those who have the keys


def huge_incarnations(target: Target) -> Seen:
    huge = 2**63 - 1
    bye = seal("bye", {"reason": "x"}, [])
    target.ask(target.hello(incarnation=huge), target.hello(incarnation=MAX_COUNT))
    target.ask(target.hello(), bye, target.hello(incarnation=1, first=MAX_COUNT))
    target.ask(target.hello(index=3001, first=huge), target.hello(index=3002, first=MAX_COUNT))
    return target.cheap(lambda: None)


def large_topic(target: Target) -> Seen:
    """Row 4: by one without keys, and in parts by those who have them.

    ZeroMQ's own end of a longer topic overflows its stack.
    """

    def topics() -> None:
        subscribe(target.where["weights_endpoint"], 16 * MIB)
        with ExitStack() as opened:
            for _ in range(64):
                one = opened.enter_context(target.peer(zmq.SUB))
                one.setsockopt(zmq.SUBSCRIBE, b"x" * 32 * 1024)
            time.sleep(2.0)

    return target.cheap(topics, 16.0)


def unread_weights(target: Target) -> Seen:
    def want() -> None:
        with target.peer(RCVHWM=1, RCVBUF=4096) as one:
            one.send_multipart(target.hello(index=3010))
            for _ in range(1000):
                one.send_multipart(WantWeights("x", -1).encode())
            time.sleep(2.0)

    return target.cheap(want, 32.0)


def many_incarnations(target: Target) -> Seen:
    def join() -> None:
        with target.peer() as one:
            for number in range(4096):
                one.send_multipart(hellos[number % 2])
                while one.poll(0):
                    one.recv_multipart()
                if number % 64 == 0:
                    time.sleep(LOOK_S / 10)

    hellos = [target.hello(index=3020, process=name) for name in ("one", "other")]
    return target.cheap(join, 16.0)


def million_frames(target: Target) -> Seen:
    def send() -> None:
        with target.peer() as one:
            one.send_multipart([b"x"] * 1_000_000)
            time.sleep(1.0)

    return target.cheap(send, 512.0)


def identities(target: Target) -> Seen:
    def connect() -> None:
        with ExitStack() as opened:
            made = [opened.enter_context(target.peer()) for _ in range(500)]
            for number, one in enumerate(made):
                hello = target.hello(index=4000 + number, process=f"p{number}")
                one.send_multipart(hello if number < 300 else Heartbeat({}).encode())
            time.sleep(1.0)

    return target.cheap(connect)


def forged_messages(target: Target) -> Seen:
    dice, valid = random.Random(0), valid_messages(target.setup)

    def send() -> None:
        with target.peer() as one:
            for _ in range(5000):
                one.send_multipart(fuzzed(valid, dice) or [b""])
                while one.poll(0):
                    one.recv_multipart()

    return target.cheap(send)


def invalid_utf8(target: Target) -> Seen:
    forged = target.hello()[0].replace(b"attacker", b"\xff\xfe\xc0\x80bad!")
    target.ask(resealed([forged]), [b"\xff" * 300], [b"\x00"])
    return target.cheap(lambda: None)


def deaf_subscribers(target: Target) -> Seen:
    def subscribe() -> None:
        with ExitStack() as opened:
            for _ in range(20):
                one = opened.enter_context(target.peer(zmq.SUB, RCVHWM=1, RCVBUF=4096))
                one.setsockopt(zmq.SUBSCRIBE, b"")
            time.sleep(4.0)

    return target.cheap(subscribe)


def degenerate_batches(target: Target) -> Seen:
    setup, spec = target.setup, EpisodeSpec.of(target.setup)
    header, *frames = EpisodeBatch(1, 0, episodes_of(setup, 4)).encode(spec)
    sent = []
    for place, frame in enumerate(frames):
        for value in (np.nan, np.inf, 1e30):
            row = np.full(len(frame) // 4, value, np.float32).tobytes()[: len(frame)]
            sent.append([header, *frames[:place], row, *frames[place + 1 :]])
    sent += [[header], [header, *frames[1:]], [header, *frames, b""], [header, b"", *frames[1:]]]
    answers = target.ask(target.hello(index=3030), *map(resealed, sent))
    held, seen = target.cheap(lambda: None)
    return held and answers > len(sent), f"{answers - 1} of {len(sent)} answered; {seen}"


# Those who have none


def large_frames(target: Target) -> Seen:
    with Strangers(target.where["endpoint"], 30, 31 * MIB) as strangers:
        return target.cheap(lambda: lasting(3.0, strangers.push))


def thousand_strangers(target: Target) -> Seen:
    with Strangers(target.where["endpoint"], 1000, MAX_FRAME_BYTES) as strangers:
        return target.cheap(lambda: lasting(5.0, strangers.push))


def idle_connections(target: Target) -> Seen:
    with Strangers(target.where["endpoint"], 3300) as strangers:
        lasting(4.0, strangers.push)
        held = target.goes_on(100.0)
        return held, f"{strangers.connected:,} connected, the run {'goes on' if held else 'stands'}"


def uninvited(target: Target, role: str = "") -> Seen:
    setup, spec = target.setup, EpisodeSpec.of(target.setup)
    corners = np.zeros((1, setup.layout.corner_count, 2), np.float32)
    forged = Scores(1, {"mean_reward": 0.999}, corners, corners, corners).encode(spec)
    evaluator = target.hello(role="evaluator", index=0)
    answers = target.ask(evaluator, forged, Heartbeat({}).encode(), role=role)
    score = target.numbers().get("test/mean_reward", 0.0)
    held = (role or not answers) and abs(score - 0.999) > 1e-9 and target.goes_on()
    return bool(held), f"{answers} answers, mean reward {score:.3f}"


def player_as_evaluator(target: Target) -> Seen:
    return uninvited(target, "player")


def impostor(target: Target) -> Seen:
    setup, where = target.setup, target.where
    info = WelcomeInfo(where["run_id"], 0, setup.fingerprints(), EpisodeSpec.of(setup))
    with Hub(HOST, 0, info) as hub:
        file = target.folder.parent / "impostor.json"
        file.write_text(json.dumps(where | {"endpoint": hub.endpoint}))
        fingerprints, timing = setup.fingerprints(), Timing(join_s=5.0)
        with Client(str(file), "player", -1, fingerprints, info.spec, timing=timing) as client:
            until_s = time.monotonic() + 4.0
            with suppress(TangramError):
                while not client.joined and time.monotonic() < until_s:
                    client.poll(0.01)
                    hub.poll(0.01)
            return not client.joined, "a worker joins it" if client.joined else "nobody joins it"


def garbage(target: Target) -> Seen:
    dice = random.Random(1)

    def send() -> None:
        with ExitStack() as opened:
            ones = [
                opened.enter_context(socket.create_connection(target.port(name)))
                for name in ("endpoint", "weights_endpoint", "http")
            ]
            for one in ones:
                one.settimeout(0.1)
                with suppress(OSError):
                    one.sendall(dice.randbytes(10_000))

    return target.cheap(lambda: lasting(3.0, send, 0.03))


# HTTP


@contextmanager
def askers(target: Target, count: int, words: bytes) -> Iterator[list[socket.socket]]:
    """So many connections at once to where HTTP is spoken, which have said these words."""
    with ExitStack() as opened:
        asking = [opened.enter_context(socket.socket()) for _ in range(count)]
        for one in asking:
            one.setblocking(False)
            one.connect_ex(target.port("http"))
        time.sleep(2.0)
        for one in asking:
            with suppress(OSError):
                one.sendall(words)
        yield asking


def reset_requests(target: Target) -> Seen:
    with askers(target, 100, b"GET /metrics") as asking:
        for one in asking:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    time.sleep(2.0)
    count = target.told().count("Traceback")
    counted = "HTTP requests without an answer" in target.told()
    return counted and not count, f"{count} tracebacks, {'counted' if counted else 'not a word'}"


def slow_requests(target: Target) -> Seen:
    threads = target.master.num_threads()
    with askers(target, 600, b"GET /"):
        more = target.master.num_threads() - threads
    until_s, answer = time.monotonic() + 15.0, b""
    while b"200" not in answer and time.monotonic() < until_s:
        with suppress(OSError), socket.create_connection(target.port("http"), 5.0) as one:
            one.sendall(b"GET /healthz HTTP/1.0\r\n\r\n")
            answer = one.recv(100)
    held = more <= 100 and b"200" in answer and target.goes_on()
    return held, f"{more} threads more; then {answer[:15]!r}"


LIVE: list[tuple[str, str, str, Callable[[Target], Seen]]] = [
    ("1", "HELLO, BYE and HELLO with the largest numbers", "6 messages", huge_incarnations),
    ("3", "frames before the handshake", "30 of 31 MiB", large_frames),
    ("3", "strangers with all that they may say", "1,000 at a time, 5 s", thousand_strangers),
    ("4", "a topic on the weights socket", "16 MiB and 64 of 32 KiB", large_topic),
    ("5", "an evaluator's scores without keys", "3 messages", uninvited),
    ("5", "an evaluator's scores with a player's key", "3 messages", player_as_evaluator),
    ("5", "an impostor with the run's name", "1 for 4 s", impostor),
    ("9", "idle connections", "3,300 for 4 s", idle_connections),
    ("10", "HTTP requests that are reset", "100", reset_requests),
    ("12", "requests for weights, never read", "1,000", unread_weights),
    ("12", "incarnations", "4,096", many_incarnations),
    ("held", "a message of many frames", "1,000,000", million_frames),
    ("held", "identities; workers at once", "500; 300", identities),
    ("held", "garbage on three ports", "1 MB/s, 3 s", garbage),
    ("held", "forged headers and messages", "5,000", forged_messages),
    ("held", "subscribers that never read", "20", deaf_subscribers),
    ("held", "slow HTTP clients", "600", slow_requests),
    ("held", "texts that are no UTF-8", "3 messages", invalid_utf8),
    ("held", "degenerate batches", "19", degenerate_batches),
]
