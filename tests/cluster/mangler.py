"""A ZeroMQ relay between workers and a master that repeats, swaps and damages what passes."""

import random
from collections import Counter
from threading import Event, Thread
from typing import Self

import zmq

from tangram_agent.arrays import MAX_FRAME_BYTES
from tangram_agent.schema import CHECKSUM

DAMAGE = (
    "without its end",
    "cut short",
    "a bit of an array",  # its lowest: what was within its bounds stays there
    "a bit of the header",
    "a bit of the checksum",
)
KINDS = ("repeated", "swapped", "random", "oversized", *DAMAGE)
SHARE = 0.5  # of the messages that something happens to
OVERSIZED = 5  # in each direction: each cuts the connection, or fills it for a while
Frames = list[bytes]


class Mangler:
    """Messages arrive, and with them what nobody sent.

    Damage comes right after the message that it is made of, or in its place, so that it must be
    sent again.

    Attributes:
        port: to connect to.
        done: what was done, by kind and direction.
    """

    def __init__(self, target: str, seed: int) -> None:
        self._target, self._dice = target, random.Random(seed)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._front = self._context.socket(zmq.ROUTER)
        self.port = self._front.bind_to_random_port("tcp://127.0.0.1")
        self._backs: dict[bytes, zmq.Socket[bytes]] = {}
        self._held: dict[tuple[bytes, str], Frames] = {}
        self._bag: dict[str, list[str]] = {"up": [], "down": []}
        self.done: Counter[tuple[str, str]] = Counter()
        self._ends = Event()
        self._thread = Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join()
        self._context.destroy(linger=0)

    def _serve(self) -> None:
        while not self._ends.is_set():
            poller = zmq.Poller()
            for socket in (self._front, *self._backs.values()):
                poller.register(socket, zmq.POLLIN)
            ready = dict(poller.poll(50))
            if self._front in ready:
                worker, *frames = self._front.recv_multipart()
                self._pass_on(worker, "up", frames)
            for worker, back in list(self._backs.items()):
                if back in ready:
                    self._pass_on(worker, "down", back.recv_multipart())

    def _send(self, worker: bytes, way: str, frames: Frames) -> None:
        if way == "down":
            self._front.send_multipart([worker, *frames])
            return
        if worker not in self._backs:
            self._backs[worker] = self._context.socket(zmq.DEALER)
            self._backs[worker].connect(self._target)
        self._backs[worker].send_multipart(frames)

    def _pass_on(self, worker: bytes, way: str, frames: Frames) -> None:
        kind = self._kind(way)
        if kind == "swapped" and (worker, way) not in self._held:
            self._held[worker, way] = frames
            return
        if kind not in DAMAGE or self._dice.random() < 0.5:
            self._send(worker, way, frames)
        more = self._more(kind, frames)
        if more is not None:
            self.done[kind, way] += 1
            self._send(worker, way, more)
        late = self._held.pop((worker, way), None)
        if late is not None:
            self.done["swapped", way] += 1
            self._send(worker, way, late)

    def _kind(self, way: str) -> str:
        """Each kind as often as the others, in random order."""
        if self._dice.random() > SHARE:
            return ""
        if not self._bag[way]:
            self._bag[way] = self._dice.sample(KINDS, k=len(KINDS))
        kind = self._bag[way].pop()
        return "" if kind == "oversized" and self.done[kind, way] >= OVERSIZED else kind

    def _more(self, kind: str, frames: Frames) -> Frames | None:  # noqa: PLR0911  # a table
        header, *arrays = frames
        match kind:
            case "repeated":
                return frames
            case "random":
                return [self._dice.randbytes(self._dice.randrange(300)) for _ in range(3)]
            case "oversized":
                return [header, bytes(MAX_FRAME_BYTES + 1)]
            case "without its end":
                return frames[:-1] or [b""]
            case "cut short":
                return [*frames[:-1], frames[-1][: len(frames[-1]) // 2]]
            case "a bit of an array":
                if not arrays:  # it has none; the others are damaged in other ways
                    return None
                number = self._dice.randrange(len(arrays))
                place = 4 * self._dice.randrange(len(arrays[number]) // 4)
                arrays[number] = self._flipped(arrays[number], place, bit=0)
                return [header, *arrays]
            case "a bit of the header" | "a bit of the checksum":
                start = 0 if kind == "a bit of the header" else len(header) - CHECKSUM
                place = self._dice.randrange(start, len(header))
                return [self._flipped(header, place, self._dice.randrange(8)), *arrays]
        return None

    @staticmethod
    def _flipped(frame: bytes, place: int, bit: int) -> bytes:
        changed = bytearray(frame)
        changed[place] ^= 1 << bit
        return bytes(changed)
