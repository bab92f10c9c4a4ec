"""Frames back into messages: one decoder for each direction, which raises nothing but WireError."""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from tangram_agent.frames import MAX_ID, Fields, unpack_header
from tangram_agent.payloads import (
    MAX_EPISODES,
    EpisodeSpec,
    WeightShapes,
    decode_columns,
    decode_episodes,
    decode_weights,
)
from tangram_agent.standing import AskStatus, RunStatus, read_status
from tangram_agent.wire import (
    MAX_PICTURES,
    ROLES,
    Ack,
    Alive,
    Bye,
    EpisodeBatch,
    Go,
    Greet,
    Heartbeat,
    Hello,
    Refused,
    Reject,
    Scores,
    Stop,
    ToMaster,
    ToWorker,
    WantWeights,
    WeightsMessage,
    Welcome,
)
from tangram_sim.errors import WireError

Message = TypeVar("Message")

MAX_INDEX = 65_535
MAX_WINDOW = 1024
MAX_ADDRESS = 256
MAX_RUN_ID = 256


class BatchError(WireError):
    """A batch whose number could be read but whose content is refused.

    Attributes:
        sequence: number of the batch.
    """

    def __init__(self, sequence: int, reason: str) -> None:
        super().__init__(reason)
        self.sequence = sequence


def decode_from_worker(frames: Sequence[bytes], spec: EpisodeSpec) -> ToMaster | AskStatus:
    """A worker's message.

    Args:
        frames: without the identity.
        spec: the task that arrays must belong to.

    Raises:
        ProtocolError: the worker speaks another version.
        BatchError: a numbered batch with wrong content.
        WireError: anything else that is wrong; the reason names the field.
    """
    fields = _header(frames)
    if fields.kind == "episodes":
        return _episodes(fields, frames[1:], spec)
    if fields.kind == "scores":
        return _scores(fields, frames[1:], spec)
    return _plain(fields, frames, _FROM_WORKER)


def decode_from_master(
    frames: Sequence[bytes], shapes: WeightShapes | None
) -> ToWorker | RunStatus:
    """The master's message.

    Args:
        frames: all of it.
        shapes: of the tensors that weights must have; None takes any.

    Raises:
        ProtocolError: the master speaks another version.
        WireError: anything else that is wrong; the reason names the field.
    """
    fields = _header(frames)
    if fields.kind == "weights":
        fields.end()
        if len(frames) != 2:
            raise WireError(f"weights: there must be 2 frames, got {len(frames)}")
        return WeightsMessage(*decode_weights(frames[1], shapes))
    if fields.kind == RunStatus.kind:
        return read_status(fields, frames[1:])
    return _plain(fields, frames, _FROM_MASTER)


def _header(frames: Sequence[bytes]) -> Fields:
    if not frames:
        raise WireError("the message is empty")
    return unpack_header(frames[0])


def _plain(
    fields: Fields, frames: Sequence[bytes], readers: Mapping[str, Callable[[Fields], Message]]
) -> Message:
    reader = readers.get(fields.kind)
    if reader is None:
        raise WireError(f"unknown kind of message {fields.kind!r}")
    if len(frames) != 1:
        raise WireError(f"{fields.kind}: there must be 1 frame, got {len(frames)}")
    message = reader(fields)
    fields.end()
    return message


def _episodes(fields: Fields, frames: Sequence[bytes], spec: EpisodeSpec) -> EpisodeBatch:
    sequence = fields.integer("sequence", 1)
    try:
        version = fields.integer("weights_version", -1)
        count = fields.integer("count", 1, spec.max_count)
        fields.end()
        return EpisodeBatch(sequence, version, decode_episodes(frames, count, spec))
    except WireError as error:
        raise BatchError(sequence, str(error)) from None


def _scores(fields: Fields, frames: Sequence[bytes], spec: EpisodeSpec) -> Scores:
    version, scalars = fields.integer("weights_version", -1), fields.numbers("scalars")
    count = fields.integer("count", 0, MAX_PICTURES)
    fields.end()
    return Scores(version, scalars, **decode_columns(frames, spec.pictures(count)))


def _hello(fields: Fields) -> Hello:
    hello = Hello(
        role=fields.text("role", choices=ROLES),
        index=fields.integer("index", -1, MAX_INDEX),
        incarnation=fields.integer("incarnation", 0),
        process=fields.text("process", MAX_ID),
        first=fields.integer("first", 1),
        fingerprints=fields.texts("fingerprints", MAX_ID),
    )
    if not hello.process:
        raise WireError("hello: process must not be empty")
    return hello


def _welcome(fields: Fields) -> Welcome:
    return Welcome(
        epoch=fields.text("epoch", MAX_ID),
        run_id=fields.text("run_id", MAX_RUN_ID),
        seed=fields.integer("seed", 0),
        index=fields.integer("index", 0, MAX_INDEX),
        incarnation=fields.integer("incarnation", 1),
        weights_endpoint=fields.text("weights_endpoint", MAX_ADDRESS),
        window=fields.integer("window", 1, MAX_WINDOW),
        lockstep=fields.boolean("lockstep"),
    )


def _go(fields: Fields) -> Go:
    return Go(
        number=fields.integer("number", 0),
        version=fields.integer("version", -1),
        first_episode=fields.integer("first_episode", 0),
        episodes=fields.integer("episodes", 1, MAX_EPISODES),
    )


def _reject(fields: Fields) -> Reject:
    return Reject(
        reason=fields.text("reason"),
        sequence=fields.integer("sequence", 0),
        final=fields.boolean("final"),
    )


_FROM_WORKER: Mapping[str, Callable[[Fields], ToMaster | AskStatus]] = {
    Hello.kind: _hello,
    WantWeights.kind: lambda f: WantWeights(f.text("epoch", MAX_ID), f.integer("version", -1)),
    Heartbeat.kind: lambda f: Heartbeat(f.numbers("stats")),
    Bye.kind: lambda f: Bye(f.text("reason")),
    AskStatus.kind: lambda _: AskStatus(),
}
_FROM_MASTER: Mapping[str, Callable[[Fields], ToWorker]] = {
    Welcome.kind: _welcome,
    Go.kind: _go,
    Refused.kind: lambda f: Refused(f.text("reason")),
    Greet.kind: lambda _: Greet(),
    Ack.kind: lambda f: Ack(f.integer("sequence", 1), f.boolean("duplicate")),
    Reject.kind: _reject,
    Alive.kind: lambda f: Alive(f.integer("version", -1)),
    Stop.kind: lambda f: Stop(f.text("reason")),
}
