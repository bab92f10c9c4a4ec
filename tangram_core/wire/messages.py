"""All messages between workers and the master, each declared once; see `schema` for the rules.

To add a field, add one line to its class; to add a message, write its class and name it in ToMaster
or ToWorker.

Delivery: batches are numbered from 1 within an incarnation and sent in order, at least once. The
master takes them in order, acknowledges a batch after its insert, and drops duplicates.
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
WINDOW = 4  # most unacknowledged messages of a worker; play pauses when they are reached
MAX_WINDOW = 1024
PICTURE_WIDTH, PICTURE_HEIGHT = 1024, 768  # pixels, of the largest picture
MAX_ROWS = 4096
GAP = "must come first"  # a worker reads it in a refusal
TAKEN_OVER = "was taken over by a newer process"  # tangram-train reads it in a worker's log
OPEN = "service.auth=off: open to whoever reaches the port"


class BatchError(WireError):
    """A batch that arrived undamaged has wrong content; sending it again would not help."""

    def __init__(self, sequence: int, reason: str) -> None:
        super().__init__(reason)
        self.sequence = sequence


Count = Annotated[int, Between(0)]
Number = Annotated[int, Between(1)]
Version = Annotated[int, Between(-1)]  # version of weights; -1: no weights
Index = Annotated[int, Between(0, MAX_INDEX)]
Role = Annotated[str, Text(choices=ROLES)]
Id = Annotated[str, Text(MAX_ID)]
RunId = Annotated[str, Text(MAX_RUN_ID)]
Reason = Annotated[str, Text(cut=True)]
YesOrNo = Annotated[bool, Flag()]


# Messages


@dataclass(frozen=True)
class Hello(Message):
    """A process asks to take part, or to go on after the connection was lost.

    Attributes:
        role: player or evaluator; indices are counted for each role.
        index: the wanted index, or -1 for any.
        incarnation: 0 for a new process, else the one that the master gave.
        process: random id of the process, the same in all HELLOs of the process.
        first: number of the oldest batch that may still be sent.
        fingerprints: section of the settings -> digest.
        run_id: id of the wanted run; empty if the process knows only an address.
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
    """A worker asks for newer weights than its own, which `epoch` and `version` name."""

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
    """Anybody asks for the status of the run; no HELLO is needed."""

    kind: ClassVar[str] = "ask_status"


@dataclass(frozen=True, eq=False)
class EpisodeBatch(Table):
    """Whole episodes; batches are numbered from 1 within an incarnation; version -1: no weights."""

    kind: ClassVar[str] = "episodes"
    sequence: Number
    weights_version: Version
    episodes: Episodes

    @classmethod
    def rows(cls, agreed: EpisodeSpec) -> Between:
        """Bounds of the number of episodes."""
        return Between(1, most_episodes(agreed))

    @classmethod
    def columns(cls, agreed: EpisodeSpec, count: int) -> Sequence[Column]:
        """One column for each array of an episode."""
        return columns(agreed, count)

    def arrays(self) -> Mapping[str, Any]:
        """The arrays of the episodes."""
        return self.episodes.arrays

    @classmethod
    def refused(cls, header: Mapping[str, Any], error: WireError) -> WireError:
        """A BatchError with the number of the batch, if the header has one."""
        sequence = header.get("sequence")
        if type(sequence) is int and 1 <= sequence <= MAX_COUNT:
            return BatchError(sequence, str(error))
        return error

    @classmethod
    def filled(cls, values: dict[str, Any], arrays: dict[str, Any]) -> Self:
        """The message with the arrays as episodes."""
        return cls(**values, episodes=Episodes(arrays))


@dataclass(frozen=True, eq=False)
class Scores(Table):
    """Results of one evaluation.

    Attributes:
        weights_version: version of the tested weights.
        scalars: name -> value.
        picture: (H, PICTURE_WIDTH, 3) of a few test episodes; H = 0: no picture.
    """

    kind: ClassVar[str] = "scores"
    weights_version: Version
    scalars: Annotated[Mapping[str, float], Numbers()]
    picture: Pixels

    @classmethod
    def rows(cls, _agreed: EpisodeSpec) -> Between:
        """Bounds of the height of the picture."""
        return Between(0, PICTURE_HEIGHT)

    @classmethod
    def columns(cls, _agreed: EpisodeSpec, count: int) -> Sequence[Column]:
        """One column for the picture."""
        return [Column("picture", "u1", (count, PICTURE_WIDTH, 3), 0, 255)]


@dataclass(frozen=True)
class Welcome(Message):
    """The master accepts a process.

    Attributes:
        epoch: random id of the master process; a restarted master has a new one.
        run_id: id of the run.
        seed: seed of the run, from which workers derive their seeds.
        index: index of the process within its role.
        incarnation: incarnation of the process within its index, from 1.
        weights_endpoint: address of the PUB socket.
        window: most unacknowledged batches that the master accepts.
        lockstep: whether to play only the episodes that Go orders.
    """

    kind: ClassVar[str] = "welcome"
    epoch: Id
    run_id: RunId
    seed: Annotated[int, Between(0, MAX_SEED)]  # given by the user, and never incremented
    index: Index
    incarnation: Number
    weights_endpoint: Annotated[str, Text(MAX_ADDRESS)]
    window: Annotated[int, Between(1, MAX_WINDOW)]
    lockstep: YesOrNo


@dataclass(frozen=True)
class Go(Message):
    """In lockstep, the episodes that a player plays next; may be sent more than once.

    Attributes:
        number: number of the round.
        version: version of the weights to play with.
        first_episode: number of the first episode, which determines its generator.
        episodes: number of episodes, sent in one batch.
    """

    kind: ClassVar[str] = "go"
    number: Count
    version: Version
    first_episode: Count
    episodes: Annotated[int, Between(1, MAX_EPISODES)]


@dataclass(frozen=True)
class Refused(Message):
    """The master does not accept a process.

    Attributes:
        reason: reason in words.
        later: whether it may be accepted when others have left.
    """

    kind: ClassVar[str] = "refused"
    reason: Reason
    later: YesOrNo = False


@dataclass(frozen=True)
class Greet(Message):
    """The master does not know this connection, for example after a restart: say HELLO again."""

    kind: ClassVar[str] = "greet"


@dataclass(frozen=True)
class Ack(Message):
    """A batch is in the replay buffer; duplicate: it was there before."""

    kind: ClassVar[str] = "ack"
    sequence: Number
    duplicate: YesOrNo


@dataclass(frozen=True)
class Reject(Message):
    """A message is refused.

    Attributes:
        reason: reason in words.
        sequence: number of the batch; 0 if the message had none, or was damaged.
        final: true: the content is wrong and must not be sent again; false: the message came out of
            order, or was damaged in transit.
    """

    kind: ClassVar[str] = "reject"
    reason: Reason
    sequence: Count
    final: YesOrNo


@dataclass(frozen=True)
class Alive(Message):
    """The answer to a heartbeat; a worker with an older version asks for the newest weights."""

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
        """Bounds of the version of the weights."""
        return {"version": Between(0)}

    def pack(self, _agreed: Any) -> tuple[Mapping[str, int], list[bytes]]:
        """All tensors in one frame."""
        return {"version": self.weights.version}, [encode_tensors(self.weights.tensors)]

    @classmethod
    def unpack(
        cls, values: dict[str, Any], frames: Sequence[bytes], agreed: WeightShapes | None
    ) -> Self:
        """The message; WireError unless the tensors have the agreed shapes."""
        check_frames(cls.kind, frames, 1)
        weights = Weights(values.pop("version"), decode_tensors(frames[0], agreed))
        return cls(**values, weights=weights)


WORKER_COLUMNS = (
    "evaluator",  # 1, or 0 for a player
    "index",
    "incarnation",
    "silent_s",  # seconds since the last message
    "behind",  # updates since the weights of the last batch; -1 before the first batch
    "batches",  # since it joined, as the next two
    "episodes",
    "transitions",
    "waiting",  # batches without acknowledgement
)


@dataclass(frozen=True, eq=False)
class RunStatus(Table):
    """Status of a run. Entries that a receiver would refuse are left out or cut, see Numbers.

    Attributes:
        numbers: name -> value.
        texts: name -> text, such as the current activity and the id of the run.
        workers: (P, 9) float64, a row for each of P processes; see WORKER_COLUMNS.
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
        """Bounds of the number of processes."""
        return Between(0, MAX_ROWS)

    @classmethod
    def columns(cls, _agreed: Any, count: int) -> Sequence[Column]:
        """One column for the table of processes."""
        return [Column("workers", "<f8", (count, len(WORKER_COLUMNS)), -1.0, MAX_NUMBER)]


ToMaster = Hello | EpisodeBatch | Scores | WantWeights | Heartbeat | Bye | AskStatus
ToWorker = Welcome | Go | Refused | Greet | Ack | Reject | Alive | Stop | WeightsMessage | RunStatus


# Reading


def decode_from_worker(frames: Sequence[bytes], spec: EpisodeSpec) -> ToMaster:
    """Decode a message from a worker.

    Args:
        frames: the frames without the identity.
        spec: spec of the task, which arrays must match.

    Raises:
        ProtocolError: the worker speaks another version.
        DamagedError: the message was damaged in transit.
        BatchError: a numbered batch has wrong content.
        WireError: any other fault; the reason names the field.
    """
    return cast("ToMaster", received(frames, _FROM_WORKER, spec))


def decode_from_master(frames: Sequence[bytes], shapes: WeightShapes | None) -> ToWorker:
    """Decode a message from the master.

    Args:
        frames: all frames.
        shapes: tensor name -> shape that weights must have; None: any.

    Raises:
        WireError: as in `decode_from_worker`.
    """
    return cast("ToWorker", received(frames, _FROM_MASTER, shapes))


def decode_weights(frame: bytes, shapes: WeightShapes | None) -> tuple[str, Weights]:
    """The master's epoch and weights from a broadcast; errors as in `decode_from_master`."""
    frames = split_frames(frame)
    message = read(WeightsMessage, opened(frames), frames[1:], shapes)
    return message.epoch, message.weights


_FROM_WORKER, _FROM_MASTER = by_kind(ToMaster), by_kind(ToWorker)
