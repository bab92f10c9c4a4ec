"""Messages between workers and the master, as lists of frames; nothing here knows a socket.

The first frame is a msgpack header (`frames`), raw arrays follow (`payloads`). Each message is a
frozen dataclass with `encode`; `decoding` has one decoder for each direction.

Worker -> master: Hello, EpisodeBatch, Scores, WantWeights, Heartbeat, Bye.
Master -> worker: Welcome, Go, Refused, Greet, Ack, Reject, Alive, WeightsMessage, Stop.

Delivery: batches are numbered from 1 within an incarnation and sent in order, at least once. The
master acknowledges a batch after its insert, takes them in order, and drops what it had before.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar

from tangram_agent.frames import MAX_TEXT, checked_numbers, pack_header
from tangram_agent.payloads import EpisodeSpec, encode_episodes
from tangram_agent.types import Episodes, Weights
from tangram_sim.arrays import Singles
from tangram_sim.errors import WireError

ROLES = ("player", "evaluator")
MAX_PICTURES = 64


@dataclass(frozen=True)
class Plain:
    """A message that is nothing but a header."""

    kind: ClassVar[str]

    def encode(self) -> list[bytes]:
        """The message's frames."""
        return [pack_header(self.kind, {f.name: getattr(self, f.name) for f in fields(self)})]


@dataclass(frozen=True)
class Reasoned(Plain):
    """A header with a reason, cut to what a receiver accepts."""

    reason: str

    def __post_init__(self) -> None:
        short = self.reason.encode(errors="replace")[:MAX_TEXT].decode(errors="ignore")
        object.__setattr__(self, "reason", short)


@dataclass(frozen=True)
class Hello(Plain):
    """A process asks to take part, or to go on after it lost the master.

    Attributes:
        role: player or evaluator; each role counts its own indices.
        index: wanted, or -1 for any.
        incarnation: 0 for a new process, else the one that the master gave it.
        process: random id of the process, the same in each of its HELLOs.
        first: number of the oldest batch that it may still send.
        fingerprints: section of the settings -> digest.
    """

    kind: ClassVar[str] = "hello"
    role: str
    index: int
    incarnation: int
    process: str
    first: int
    fingerprints: Mapping[str, str]


@dataclass(frozen=True)
class WantWeights(Plain):
    """A worker asks for the current weights unless they are of this epoch and version."""

    kind: ClassVar[str] = "want_weights"
    epoch: str
    version: int


@dataclass(frozen=True)
class Heartbeat(Plain):
    """A sign of life with numbers for the master's log; answered by Alive."""

    kind: ClassVar[str] = "heartbeat"
    stats: Mapping[str, float]

    def encode(self) -> list[bytes]:
        """The message's frames; WireError for names or values that the master would refuse."""
        return [pack_header(self.kind, {"stats": checked_numbers("heartbeat", self.stats)})]


@dataclass(frozen=True)
class Bye(Reasoned):
    """A worker leaves of its own accord."""

    kind: ClassVar[str] = "bye"


@dataclass(frozen=True, eq=False)
class EpisodeBatch:
    """Whole episodes, as played.

    Attributes:
        sequence: number of the batch, from 1 within an incarnation.
        weights_version: of the weights that played it; -1 for none.
        episodes: the arrays.
    """

    sequence: int
    weights_version: int
    episodes: Episodes

    def encode(self, spec: EpisodeSpec) -> list[bytes]:
        """The message's frames; WireError for content that the master would refuse."""
        arrays = encode_episodes(self.episodes, spec)
        header = {
            "sequence": self.sequence,
            "weights_version": self.weights_version,
            "count": self.episodes.count,
        }
        return [pack_header("episodes", header), *arrays]


@dataclass(frozen=True, eq=False)
class Scores:
    """Results of one evaluation.

    Attributes:
        weights_version: of the weights that were tested.
        scalars: name -> value, at most 64.
        starts, ends, goals: (n, V, 2) float32 corners of n <= 64 test episodes, for pictures.
    """

    weights_version: int
    scalars: Mapping[str, float]
    starts: Singles
    ends: Singles
    goals: Singles

    def encode(self, spec: EpisodeSpec) -> list[bytes]:
        """The message's frames; WireError for content that the master would refuse."""
        count = len(self.starts)
        if count > MAX_PICTURES:
            raise WireError(f"scores: at most {MAX_PICTURES} test episodes, got {count}")
        header = {
            "weights_version": self.weights_version,
            "scalars": checked_numbers("scores", self.scalars),
            "count": count,
        }
        arrays = [c.encode(getattr(self, c.name)) for c in spec.pictures(count)]
        return [pack_header("scores", header), *arrays]


@dataclass(frozen=True)
class Welcome(Plain):
    """The master takes a process in.

    Attributes:
        epoch: random id of this life of the master.
        run_id: of the run.
        seed: of the run, from which workers derive theirs.
        index: of the process within its role.
        incarnation: of the process within its index, from 1.
        weights_endpoint: of the PUB socket.
        window: most batches that the master accepts unacknowledged.
        lockstep: play only what Go says.
    """

    kind: ClassVar[str] = "welcome"
    epoch: str
    run_id: str
    seed: int
    index: int
    incarnation: int
    weights_endpoint: str
    window: int
    lockstep: bool


@dataclass(frozen=True)
class Go(Plain):
    """In lockstep, what a player plays next; it may come more than once.

    Attributes:
        number: of the round.
        version: of the weights to play with.
        first_episode: number of the first episode, from which its generator follows.
        episodes: how many, in one batch.
    """

    kind: ClassVar[str] = "go"
    number: int
    version: int
    first_episode: int
    episodes: int


@dataclass(frozen=True)
class Refused(Reasoned):
    """The master does not take a process in."""

    kind: ClassVar[str] = "refused"


@dataclass(frozen=True)
class Greet(Plain):
    """The master does not know this connection (it was restarted): say HELLO again."""

    kind: ClassVar[str] = "greet"


@dataclass(frozen=True)
class Ack(Plain):
    """A batch is in the replay, now or since before (duplicate)."""

    kind: ClassVar[str] = "ack"
    sequence: int
    duplicate: bool


@dataclass(frozen=True)
class Reject(Reasoned):
    """A message is refused.

    Attributes:
        sequence: of the batch, 0 where the message had none.
        final: the batch itself is wrong and must not be sent again; else it came out of turn.
    """

    kind: ClassVar[str] = "reject"
    sequence: int
    final: bool


@dataclass(frozen=True)
class Alive(Plain):
    """The answer to a heartbeat.

    Attributes:
        version: of the newest broadcast, -1 before the first: one that missed it can ask.
    """

    kind: ClassVar[str] = "alive"
    version: int


@dataclass(frozen=True)
class Stop(Reasoned):
    """The worker must end."""

    kind: ClassVar[str] = "stop"


@dataclass(frozen=True, eq=False)
class WeightsMessage:
    """The newest weights, for one worker that asked; PUB sends the second frame alone.

    Attributes:
        epoch: of the master that made them.
        weights: the tensors.
    """

    epoch: str
    weights: Weights

    @staticmethod
    def wrap(frame: bytes) -> list[bytes]:
        """The message's frames, from a frame made by `payloads.encode_weights`."""
        return [pack_header("weights", {}), frame]


ToMaster = Hello | EpisodeBatch | Scores | WantWeights | Heartbeat | Bye
ToWorker = Welcome | Go | Refused | Greet | Ack | Reject | Alive | Stop | WeightsMessage
