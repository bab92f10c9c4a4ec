"""All messages between workers and the master, each declared once; see `schema` for the rules.

To add a field, add one line to its class; to add a message, write its class and name it in ToMaster
or ToWorker.

Delivery: batches are numbered from 1 within an incarnation and sent in order, at least once. The
master acknowledges a batch after its insert, takes them in order, and drops what it had before.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self, cast

import numpy as np

from tangram_core.agent import Weights
from tangram_core.arrays import Floats, Pixels
from tangram_core.errors import WireError
from tangram_core.spec import Episodes, EpisodeSpec
from tangram_core.wire.arrays import (
    MAX_EPISODES,
    Column,
    WeightShapes,
    columns,
    decode_tensors,
    encode_tensors,
    most_episodes,
    split_frames,
)
from tangram_core.wire.schema import (
    MAX_COUNT,
    MAX_NUMBER,
    MAX_TEXT,
    Between,
    Bound,
    Flag,
    Message,
    Numbers,
    Table,
    Text,
    Texts,
    by_kind,
    check_frames,
    opened,
    read,
    received,
)

ROLES = ("player", "evaluator")
MAX_ID = 64
MAX_RUN_ID = 256
MAX_ADDRESS = 256
MAX_SEED = 2**63 - 1
MAX_INDEX = 65_535
WINDOW = 4  # messages of a worker that may be unacknowledged; a full window pauses play
MAX_WINDOW = 1024
PICTURE_WIDTH, PICTURE_HEIGHT = 1024, 768  # pixels: at most, they fill MAX_FRAMES
MAX_ROWS = 4096
TAKEN_OVER = "was taken over by a newer process"  # tangram-train reads it in a worker's log
OPEN = "service.auth=off: open to whoever reaches the port"


class BatchError(WireError):
    """An intact batch, of this number, whose content is refused: it would be wrong again."""

    def __init__(self, sequence: int, reason: str) -> None:
        super().__init__(reason)
        self.sequence = sequence


Count = Annotated[int, Between(0)]
Number = Annotated[int, Between(1)]
Version = Annotated[int, Between(-1)]  # of weights, -1 for none
Index = Annotated[int, Between(0, MAX_INDEX)]
Role = Annotated[str, Text(choices=ROLES)]
Id = Annotated[str, Text(MAX_ID)]
RunId = Annotated[str, Text(MAX_RUN_ID)]
Reason = Annotated[str, Text(cut=True)]
YesOrNo = Annotated[bool, Flag()]


# Messages


@dataclass(frozen=True)
class Hello(Message):
    """A process asks to take part, or to go on after it lost the master.

    Attributes:
        role: player or evaluator; each role counts its own indices.
        index: wanted, or -1 for any.
        incarnation: 0 for a new process, else the one that the master gave it.
        process: random id of the process, the same in each of its HELLOs.
        first: number of the oldest batch that it may still send.
        fingerprints: section of the settings -> digest.
        run_id: of the run that it wants to take part in, empty where it knows an address only.
    """

    kind: ClassVar[str] = "hello"
    role: Role
    index: Annotated[int, Between(-1, MAX_INDEX)]
    incarnation: Count
    process: Annotated[str, Text(MAX_ID, needed=True)]
    first: Number
    fingerprints: Annotated[Mapping[str, str], Texts(MAX_ID)]
    run_id: RunId


@dataclass(frozen=True)
class WantWeights(Message):
    """A worker asks for the current weights unless they are of this epoch and version."""

    kind: ClassVar[str] = "want_weights"
    epoch: Id
    version: Version


@dataclass(frozen=True)
class Heartbeat(Message):
    """A sign of life with numbers for the master's log; answered by Alive."""

    kind: ClassVar[str] = "heartbeat"
    stats: Annotated[Mapping[str, float], Numbers(lenient=True)]


@dataclass(frozen=True)
class Bye(Message):
    """A worker leaves of its own accord."""

    kind: ClassVar[str] = "bye"
    reason: Reason


@dataclass(frozen=True)
class AskStatus(Message):
    """Anybody asks how the run stands; no HELLO is needed."""

    kind: ClassVar[str] = "ask_status"


@dataclass(frozen=True, eq=False)
class EpisodeBatch(Table):
    """Whole episodes as played, numbered from 1 within an incarnation; version -1: no weights."""

    kind: ClassVar[str] = "episodes"
    sequence: Number
    weights_version: Version
    episodes: Episodes

    @classmethod
    def rows(cls, agreed: EpisodeSpec) -> Between:
        """Bounded in number and in bytes."""
        return Between(1, most_episodes(agreed))

    @classmethod
    def columns(cls, agreed: EpisodeSpec, count: int) -> Sequence[Column]:
        """One for each field of the spec."""
        return columns(agreed, count)

    def arrays(self) -> Mapping[str, Any]:
        """Those of the episodes."""
        return self.episodes.arrays

    @classmethod
    def refused(cls, header: Mapping[str, Any], error: WireError) -> WireError:
        """With the batch's number, where it has one."""
        sequence = header.get("sequence")
        if type(sequence) is int and 1 <= sequence <= MAX_COUNT:
            return BatchError(sequence, str(error))
        return error

    @classmethod
    def filled(cls, values: dict[str, Any], arrays: dict[str, Any]) -> Self:
        """With the arrays as episodes."""
        return cls(**values, episodes=Episodes(arrays))


@dataclass(frozen=True, eq=False)
class Scores(Table):
    """Results of one evaluation.

    Attributes:
        weights_version: of the weights that were tested.
        scalars: name -> value.
        picture: (H, PICTURE_WIDTH, 3) of a few test episodes, H = 0 where none was drawn.
    """

    kind: ClassVar[str] = "scores"
    weights_version: Version
    scalars: Annotated[Mapping[str, float], Numbers()]
    picture: Pixels

    @classmethod
    def rows(cls, _agreed: EpisodeSpec) -> Between:
        """Enough to look at."""
        return Between(0, PICTURE_HEIGHT)

    @classmethod
    def columns(cls, _agreed: EpisodeSpec, count: int) -> Sequence[Column]:
        """The picture, row by row."""
        return [Column("picture", "u1", (count, PICTURE_WIDTH, 3), 0, 255)]


@dataclass(frozen=True)
class Welcome(Message):
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
    epoch: Id
    run_id: RunId
    seed: Annotated[int, Between(0, MAX_SEED)]  # the user's own, and nothing counts on from it
    index: Index
    incarnation: Number
    weights_endpoint: Annotated[str, Text(MAX_ADDRESS)]
    window: Annotated[int, Between(1, MAX_WINDOW)]
    lockstep: YesOrNo


@dataclass(frozen=True)
class Go(Message):
    """In lockstep, what a player plays next; it may come more than once.

    Attributes:
        number: of the round.
        version: of the weights to play with.
        first_episode: number of the first episode, from which its generator follows.
        episodes: how many, in one batch.
    """

    kind: ClassVar[str] = "go"
    number: Count
    version: Version
    first_episode: Count
    episodes: Annotated[int, Between(1, MAX_EPISODES)]


@dataclass(frozen=True)
class Refused(Message):
    """The master does not take a process in.

    Attributes:
        reason: why.
        later: it may, when others have left.
    """

    kind: ClassVar[str] = "refused"
    reason: Reason
    later: YesOrNo = False


@dataclass(frozen=True)
class Greet(Message):
    """The master does not know this connection (it was restarted): say HELLO again."""

    kind: ClassVar[str] = "greet"


@dataclass(frozen=True)
class Ack(Message):
    """A batch is in the replay, now or since before (duplicate)."""

    kind: ClassVar[str] = "ack"
    sequence: Number
    duplicate: YesOrNo


@dataclass(frozen=True)
class Reject(Message):
    """A message is refused.

    Attributes:
        reason: why.
        sequence: of the batch, 0 where the message had none, or none to believe.
        final: the message itself is wrong and must not be sent again; else it came out of turn, or
            was damaged on its way.
    """

    kind: ClassVar[str] = "reject"
    reason: Reason
    sequence: Count
    final: YesOrNo


@dataclass(frozen=True)
class Alive(Message):
    """The answer to a heartbeat, by whose version one that missed the newest broadcast can ask."""

    kind: ClassVar[str] = "alive"
    version: Version


@dataclass(frozen=True)
class Stop(Message):
    """The worker must end."""

    kind: ClassVar[str] = "stop"
    reason: Reason


@dataclass(frozen=True, eq=False)
class WeightsMessage(Message):
    """The newest weights, and the epoch of the master that made them."""

    kind: ClassVar[str] = "weights"
    epoch: Id
    weights: Weights

    @classmethod
    def described(cls, _agreed: Any) -> Mapping[str, Bound]:
        """Their version."""
        return {"version": Between(0)}

    def pack(self, _agreed: Any) -> tuple[Mapping[str, int], list[bytes]]:
        """All tensors in one frame."""
        return {"version": self.weights.version}, [encode_tensors(self.weights.tensors)]

    @classmethod
    def unpack(
        cls, values: dict[str, Any], frames: Sequence[bytes], agreed: WeightShapes | None
    ) -> Self:
        """The message, if the tensors have the shapes that a worker agreed on."""
        check_frames(cls.kind, frames, 1)
        weights = Weights(values.pop("version"), decode_tensors(frames[0], agreed))
        return cls(**values, weights=weights)


WORKER_COLUMNS = (
    "evaluator",  # 1, or 0 for a player
    "index",
    "incarnation",
    "silent_s",  # since its last message
    "behind",  # updates since the weights that its last batch was played with; -1 before one
    "batches",  # since it joined
    "episodes",
    "transitions",
    "waiting",  # batches that are not acknowledged yet
)


@dataclass(frozen=True, eq=False)
class RunStatus(Table):
    """How a run stands. What a receiver would refuse is left out or cut, see Numbers.

    Attributes:
        numbers: name -> value.
        texts: name -> text: what it does or waits for, and who it is.
        workers: (P, 9) float64, a row for each process; see WORKER_COLUMNS.
    """

    kind: ClassVar[str] = "status"
    numbers: Annotated[Mapping[str, float], Numbers(lenient=True)]
    texts: Annotated[Mapping[str, str], Texts(MAX_TEXT, lenient=True)]
    workers: Floats

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = np.nan_to_num(self.workers[:MAX_ROWS], nan=-1.0).clip(-1.0, MAX_NUMBER)
        object.__setattr__(self, "workers", rows)

    @classmethod
    def rows(cls, _agreed: Any) -> Between:
        """As many as there may be workers."""
        return Between(0, MAX_ROWS)

    @classmethod
    def columns(cls, _agreed: Any, count: int) -> Sequence[Column]:
        """The table of workers."""
        return [Column("workers", "<f8", (count, len(WORKER_COLUMNS)), -1.0, MAX_NUMBER)]


ToMaster = Hello | EpisodeBatch | Scores | WantWeights | Heartbeat | Bye | AskStatus
ToWorker = Welcome | Go | Refused | Greet | Ack | Reject | Alive | Stop | WeightsMessage | RunStatus


# Reading


def decode_from_worker(frames: Sequence[bytes], spec: EpisodeSpec) -> ToMaster:
    """A worker's message.

    Args:
        frames: without the identity.
        spec: the task that arrays must belong to.

    Raises:
        ProtocolError: the worker speaks another version.
        DamagedError: the message was changed on its way.
        BatchError: a numbered batch with wrong content.
        WireError: anything else that is wrong; the reason names the field.
    """
    return cast("ToMaster", received(frames, _FROM_WORKER, spec))


def decode_from_master(frames: Sequence[bytes], shapes: WeightShapes | None) -> ToWorker:
    """The master's message.

    Args:
        frames: all of it.
        shapes: of the tensors that weights must have; None takes any.

    Raises:
        WireError: as in `decode_from_worker`.
    """
    return cast("ToWorker", received(frames, _FROM_MASTER, shapes))


def decode_weights(frame: bytes, shapes: WeightShapes | None) -> tuple[str, Weights]:
    """The master's epoch and its weights, from a broadcast; errors as in `decode_from_master`."""
    frames = split_frames(frame)
    message = read(WeightsMessage, opened(frames), frames[1:], shapes)
    return message.epoch, message.weights


_FROM_WORKER, _FROM_MASTER = by_kind(ToMaster), by_kind(ToWorker)
