"""Attacks on a training that listens on a port with authentication.

Each returns whether the training held, and what was observed. All traffic goes to 127.0.0.1 or to
unix sockets of this machine, and is bounded in count and time.
"""

import json
import random
import re
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial

import numpy as np
import psutil
import zmq

from master.hub.admission import WelcomeInfo
from master.hub.hub import Hub
from tangram_core.errors import TangramError
from tangram_core.wire.arrays import MAX_FRAME_BYTES
from tangram_core.wire.messages import PICTURE_WIDTH, EpisodeBatch, Heartbeat, Scores, WantWeights
from tangram_core.wire.schema import MAX_COUNT, opened, seal
from tangram_lab.benchmarks.trainings import MIB
from tangram_lab.benchmarks.trials.chaos import Witness
from tangram_lab.benchmarks.trials.forged import fuzzed, resealed, valid_messages
from tangram_lab.benchmarks.trials.strangers import Strangers, subscribe
from tangram_lab.benchmarks.trials.target import (
    ENDS_S,
    HOST,
    LOOK_S,
    ROOM_MIB,
    Attack,
    Seen,
    Target,
    episodes_of,
)
from worker.talk.client import Client
from worker.talk.connection import Timing

ROOM_FILES = 300  # allowed growth of the master's open files while strangers connect
OPEN_FILES = 1024  # limit of open files at the start of the master


def lasting(seconds: float, step: Callable[[], object], pause_s: float = 0.001) -> None:
    """Repeat `step` for some seconds."""
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        step()
        time.sleep(pause_s)


# Attackers with the keys


def huge_incarnations(target: Target) -> Seen:
    """Send HELLO with the largest incarnations, then join with the next process of that index."""

    def join() -> None:
        for huge in (2**63 - 1, MAX_COUNT):
            target.ask(target.hello(incarnation=huge))
            target.ask(target.hello(process="next"))
            again = target.hello(incarnation=1, first=huge)
            target.ask(target.hello(process="third"), bye, again, unanswered=1)
            target.ask(target.hello(index=3001, process="other", first=huge))

    bye = seal("bye", {"reason": "x"}, [])
    return target.cheap(join)


def large_topic(target: Target) -> Seen:
    """Subscribe to a topic of 16 MiB without keys, and to 64 topics of 32 KiB with keys.

    With longer ones, ZeroMQ overflows its own stack.
    """

    def topics() -> None:
        subscribe(target.where["weights_endpoint"], 16 * MIB)
        with ExitStack() as opened:
            for number in range(64):  # all different, because equal topics are stored once
                one = opened.enter_context(target.peer(zmq.SUB))
                one.setsockopt(zmq.SUBSCRIBE, bytes([number]) * 32 * 1024)
            time.sleep(2.0)

    return target.cheap(topics, 16.0)


def unread_weights(target: Target) -> Seen:
    def want() -> None:
        with ExitStack() as opened:
            for number in range(50):
                one = opened.enter_context(target.peer(RCVHWM=1, RCVBUF=4096))
                hello = target.hello(index=3100 + number, process=f"unread {number}")
                for message in [hello] + [WantWeights("x", -1).encode()] * 60:
                    one.send_multipart(message)
            time.sleep(4.0)

    return target.cheap(want, 32.0)


def many_incarnations(target: Target) -> Seen:
    """Join 4,096 processes with one index, then 4,096 others; checkpoints must not keep them."""

    def join() -> None:
        with target.peer() as one:
            for number in range(8192):
                index = 10_000 + max(0, number - 4096)
                one.send_multipart(target.hello(index=index, process=f"one {number}"))
                while one.poll(0):
                    one.recv_multipart()
                if number % 64 == 0:
                    time.sleep(LOOK_S / 10)

    held, seen = target.cheap(join, 16.0)
    known = len(target.checkpoint()["hub"])
    return held and known < 1000, f"{known:,} are kept, {seen}"


def million_frames(target: Target) -> Seen:
    """Send one message of a million frames; it is refused once it has arrived, after seconds."""
    refused: list[int] = []

    def send() -> None:
        with target.peer() as one:
            one.send_multipart([b"x"] * 1_000_000)
            refused.append(one.poll(ENDS_S * 1000))

    held, seen = target.cheap(send, 512.0)
    return held and any(refused), seen


def identities(target: Target) -> Seen:
    def connect() -> None:
        with ExitStack() as stack:
            made = [stack.enter_context(target.peer()) for _ in range(500)]
            for number, one in enumerate(made):
                hello = target.hello(index=4000 + number, process=f"p{number}")
                one.send_multipart(hello if number < 300 else Heartbeat({}).encode())
            until_s = time.monotonic() + 10.0
            while answers.total() < len(made) and time.monotonic() < until_s:
                for one in made:
                    while one.poll(0):
                        answers[opened(one.recv_multipart())["kind"]] += 1

    answers = Counter[str]()
    held, seen = target.cheap(connect)
    welcome, greet = answers["welcome"], answers["greet"]
    return held and (welcome, greet) == (300, 200), f"{welcome} let in, {greet} asked who, {seen}"


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
    return target.cheap(lambda: target.ask(resealed([forged]), [b"\xff" * 300], [b"\x00"]))


def deaf_subscribers(target: Target) -> Seen:
    def subscribe() -> None:
        with ExitStack() as opened:
            for _ in range(20):
                one = opened.enter_context(target.peer(zmq.SUB, RCVHWM=1, RCVBUF=4096))
                one.setsockopt(zmq.SUBSCRIBE, b"")
            time.sleep(4.0)

    return target.cheap(subscribe)


def degenerate_batches(target: Target) -> Seen:
    """Send invalid batches with correct sequence numbers; each must be refused for its content."""
    spec, episodes = target.setup.spec, episodes_of(target.setup, 4)
    frames = EpisodeBatch(1, 0, episodes).encode(spec)[1:]
    wrong = [[], frames[1:], [*frames, b""], [b"", *frames[1:]]]
    for place, frame in enumerate(frames):
        for value in (np.nan, np.inf, 1e30):
            row = np.full(len(frame) // 4, value, np.float32).tobytes()[: len(frame)]
            wrong.append([*frames[:place], row, *frames[place + 1 :]])
    headers = (EpisodeBatch(n, 0, episodes).encode(spec)[0] for n in range(1, 1 + len(wrong)))
    sent = [resealed([header, *rest]) for header, rest in zip(headers, wrong, strict=True)]
    answers = Counter[str]()
    held, seen = target.cheap(
        lambda: answers.update(target.ask(target.hello(index=3030, process="odd"), *sent))
    )
    refused = answers["reject"]
    return held and refused == len(sent), f"{refused} of {len(sent)} refused, {seen}"


# Attackers without keys


def besieged(target: Target, strangers: Strangers, seconds: float) -> Seen:
    """Whether strangers cost the master little, and a worker can join and play meanwhile."""
    worker, master = Witness(str(target.folder), target.setup), target.master
    with target.cost() as most:
        lasting(seconds / 2, strangers.push)
        worker.start()
        lasting(seconds / 2, strangers.push)
        until_s = time.monotonic() + ENDS_S / 2
        while not worker.acknowledged and time.monotonic() < until_s:
            lasting(LOOK_S, strangers.push)
    worker.stop()
    worker.join(ENDS_S)
    same = target.goes_on() and target.master.pid == master.pid
    few = most.mib <= ROOM_MIB and most.files <= ROOM_FILES
    seen = f"+{most.mib:.0f} of {ROOM_MIB:g} MiB, +{most.files} of {ROOM_FILES} files, "
    seen += f"a worker joins meanwhile: {worker.acknowledged > 0}"
    return same and few and worker.acknowledged > 0, seen


def large_frames(target: Target) -> Seen:
    with Strangers(target.where["endpoint"], 30, 31 * MIB) as strangers:
        return target.cheap(lambda: lasting(3.0, strangers.push))


def thousand_strangers(target: Target) -> Seen:
    with Strangers(target.where["endpoint"], 1000, MAX_FRAME_BYTES) as strangers:
        return besieged(target, strangers, 5.0)


def idle_connections(target: Target) -> Seen:
    """Open more connections than OPEN_FILES; the master must have raised its own limit."""
    soft, hard = target.master.rlimit(psutil.RLIMIT_NOFILE)
    with Strangers(target.where["endpoint"], 3300) as strangers:
        held, seen = besieged(target, strangers, 4.0)
    return held and soft > min(OPEN_FILES, hard - 1), f"of {soft:,} files it may open {seen}"


def uninvited(target: Target, role: str = "") -> Seen:
    evaluator = target.hello(role="evaluator", index=0)
    said = (evaluator, forged_scores(target, 1), Heartbeat({}).encode())
    roles = [role] if role else ["", "unknown"]
    answers = sum((target.ask(*said, role=one) for one in roles), Counter[str]())
    held, seen = unforged(target)
    return bool(role or not answers) and held, f"{answers.total()} answers, {seen}"


def forged_scores(target: Target, version: int) -> list[bytes]:
    none = np.zeros((0, PICTURE_WIDTH, 3), np.uint8)
    return Scores(version, {"mean_reward": 0.999}, none).encode(target.setup.spec)


def unforged(target: Target) -> Seen:
    """Whether no forged scores are in the curve."""
    goes_on = target.goes_on()  # by now the master has handled the messages and written the curve
    curve = target.folder / "curve.jsonl"
    told = curve.read_text() if curve.exists() else ""
    forgeries = len(re.findall(r"\b0\.999\b", told))
    return not forgeries and goes_on, f"{forgeries} forged scores"


def player_as_evaluator(target: Target) -> Seen:
    return uninvited(target, "player")


def impostor(target: Target) -> Seen:
    setup, where = target.setup, target.where
    info = WelcomeInfo(where["run_id"], 0, setup.fingerprints(), setup.spec)
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
    """Open `count` connections to the HTTP port, and send these bytes on each."""
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


def asked(target: Target, words: bytes) -> Seen:
    """Send a wrong request to the HTTP port; the answer must be neither a page nor a secret."""
    with socket.create_connection(target.port("http"), 10.0) as one:
        with suppress(OSError):  # the server may close before it has read everything
            one.sendall(words)
            one.shutdown(socket.SHUT_WR)
        answer = b""
        with suppress(OSError):
            while part := one.recv(4096):
                answer += part
    told = b" 200 " in answer or b"key" in answer
    return not told and target.goes_on(), f"answered: {answer[:30]!r}"


ODD = {
    "a way out": b"GET /../keys.json HTTP/1.0\r\n\r\n",
    "another method": b"DELETE /metrics HTTP/1.0\r\n\r\n",
    "a line of a megabyte": b"GET /" + b"x" * MIB + b" HTTP/1.0\r\n\r\n",
    "10,000 headers": b"GET /metrics HTTP/1.0\r\n" + b"x: y\r\n" * 10_000 + b"\r\n",
}


# Run first, because memory freed after other attacks would hide growth. Run with nothing else at
# work, because a worker must join in the time that strangers leave to the master.
BESIEGED: list[Attack] = [
    ("3", "strangers with all that they may say", "1,000 at a time, 5 s", thousand_strangers),
    ("9", "idle connections", "3,300 for 4 s", idle_connections),
]
LIVE: list[Attack] = [  # the attack that needs most memory is the last
    ("1", "HELLO, BYE and HELLO with the largest numbers", "12 messages", huge_incarnations),
    ("3", "frames before the handshake", "30 of 31 MiB", large_frames),
    ("4", "a topic on the weights socket", "16 MiB and 64 of 32 KiB", large_topic),
    ("5", "an evaluator's scores without a key of the run", "6 messages", uninvited),
    ("5", "an evaluator's scores with a player's key", "3 messages", player_as_evaluator),
    ("5", "an impostor with the run's name", "1 for 4 s", impostor),
    ("10", "HTTP requests that are reset", "100", reset_requests),
    ("12", "requests for weights, never read", "60 each of 50 workers", unread_weights),
    ("12", "incarnations", "8,192", many_incarnations),
    ("held", "identities; workers at once", "500; 300", identities),
    ("held", "garbage on three ports", "1 MB/s, 3 s", garbage),
    ("held", "forged headers and messages", "5,000", forged_messages),
    ("held", "subscribers that never read", "20", deaf_subscribers),
    ("held", "slow HTTP clients", "600", slow_requests),
    *(("held", f"HTTP with {what}", "1", partial(asked, words=ODD[what])) for what in ODD),
    ("held", "texts that are no UTF-8", "3 messages", invalid_utf8),
    ("held", "degenerate batches", "19", degenerate_batches),
    ("held", "a message of many frames", "1,000,000", million_frames),
]
