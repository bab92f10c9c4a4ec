"""Messages: each comes back as it was sent, and each field that is wrong is named."""

from contextlib import suppress
from dataclasses import asdict, fields
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tangram_agent.decoding import BatchError, decode_from_master, decode_from_worker
from tangram_agent.frames import MAX_HEADER, MAX_INTEGER, MAX_TEXT, PROTOCOL, ProtocolError
from tangram_agent.payloads import encode_weights
from tangram_agent.standing import AskStatus
from tangram_agent.types import Episodes
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
    Plain,
    Refused,
    Reject,
    Scores,
    Stop,
    WantWeights,
    WeightsMessage,
    Welcome,
)
from tangram_sim.errors import WireError
from tests.agent.messages import (
    SHAPES,
    SPEC,
    batch,
    episodes,
    hello,
    scores,
    weights,
    with_header,
)

pytestmark = pytest.mark.fast

NAN = float("nan")
counts = st.integers(1, MAX_INTEGER)
versions = st.integers(-1, MAX_INTEGER)
ids = st.text(min_size=1, max_size=16)
# Lone surrogates cannot be encoded; no text of ours holds them but reasons, see below.
reasons = st.text(st.characters(exclude_categories=["Cs"]), max_size=200)
words = st.text("abc_./9", min_size=1, max_size=64)
numbers = st.dictionaries(words, st.floats(-1e18, 1e18), max_size=5)
hellos = st.builds(
    Hello,
    role=st.sampled_from(ROLES),
    index=st.integers(-1, 65_535),
    incarnation=st.integers(0, MAX_INTEGER),
    process=ids,
    first=counts,
    fingerprints=st.dictionaries(words, ids, max_size=5),
)
welcomes = st.builds(
    Welcome,
    epoch=ids,
    run_id=ids,
    seed=st.integers(0, MAX_INTEGER),
    index=st.integers(0, 65_535),
    incarnation=counts,
    weights_endpoint=ids,
    window=st.integers(1, 1024),
    lockstep=st.booleans(),
)
to_master = st.one_of(
    hellos,
    st.builds(WantWeights, epoch=ids, version=versions),
    st.builds(Heartbeat, stats=numbers),
    st.builds(Bye, reason=reasons),
    st.builds(AskStatus),
)
to_worker = st.one_of(
    welcomes,
    st.builds(
        Go,
        number=st.integers(0, MAX_INTEGER),
        version=versions,
        first_episode=st.integers(0, MAX_INTEGER),
        episodes=st.integers(1, 4096),
    ),
    st.builds(Refused, reason=reasons),
    st.builds(Greet),
    st.builds(Ack, sequence=counts, duplicate=st.booleans()),
    st.builds(Reject, reason=reasons, sequence=st.integers(0, MAX_INTEGER), final=st.booleans()),
    st.builds(Alive, version=versions),
    st.builds(Stop, reason=reasons),
)


@given(to_master)
def test_messages_to_the_master_come_back_as_they_were_sent(message: Plain) -> None:
    assert decode_from_worker(message.encode(), SPEC) == message


@given(to_worker)
def test_messages_to_workers_come_back_as_they_were_sent(message: Plain) -> None:
    assert decode_from_master(message.encode(), SHAPES) == message


@given(counts, versions, st.integers(1, 5), st.integers(0, 99))
def test_batches_come_back_as_they_were_sent(
    sequence: int, version: int, count: int, seed: int
) -> None:
    sent = EpisodeBatch(sequence, version, episodes(count, seed))
    received = decode_from_worker(sent.encode(SPEC), SPEC)
    assert isinstance(received, EpisodeBatch)
    assert (received.sequence, received.weights_version) == (sequence, version)
    for field in fields(Episodes):
        left, right = getattr(received.episodes, field.name), getattr(sent.episodes, field.name)
        np.testing.assert_array_equal(left, right)


@given(st.integers(0, MAX_PICTURES), numbers, versions)
def test_scores_come_back_as_they_were_sent(
    count: int, scalars: dict[str, float], version: int
) -> None:
    corners = np.random.default_rng(count).uniform(-1, 1, (3, count, SPEC.corners, 2))
    sent = Scores(version, scalars, *corners.astype(np.float32))
    received = decode_from_worker(sent.encode(SPEC), SPEC)
    assert isinstance(received, Scores)
    assert (received.weights_version, received.scalars) == (version, scalars)
    for name in ("starts", "ends", "goals"):
        np.testing.assert_array_equal(getattr(received, name), getattr(sent, name))


def test_weights_for_one_worker_carry_the_broadcast_frame() -> None:
    frame = encode_weights("epoch", weights())
    frames = WeightsMessage.wrap(frame)
    assert frames[1] is frame
    received = decode_from_master(frames, SHAPES)
    assert isinstance(received, WeightsMessage)
    assert (received.epoch, received.weights.version) == ("epoch", 5)


@pytest.mark.parametrize("kind", [Bye, Refused, Stop])
def test_reasons_are_cut_to_what_is_received(kind: type[Bye]) -> None:
    for text in ("x" * 5000, "\u20ac" * 5000, "\ud800" * 5000):
        message = kind(text)
        assert 0 < len(message.reason.encode()) <= MAX_TEXT
        decode = decode_from_worker if kind is Bye else decode_from_master
        assert decode(message.encode(), SPEC if kind is Bye else None) == message  # type: ignore[arg-type]


INTEGER = "must be an integer between"

FROM_WORKER: list[tuple[Plain, dict[str, Any], str]] = [
    (hello(), {"role": "spy"}, "hello: role must be one of player, evaluator, got 'spy'"),
    (hello(), {"index": -2}, f"hello: index {INTEGER} -1 and 65535, got -2"),
    (hello(), {"index": 65_536}, f"hello: index {INTEGER} -1 and 65535, got 65536"),
    (hello(), {"incarnation": -1}, f"hello: incarnation {INTEGER} 0 and {MAX_INTEGER}, got -1"),
    (hello(), {"incarnation": 2**63}, f"hello: incarnation {INTEGER} 0 and {MAX_INTEGER}, got 922"),
    (hello(), {"process": ""}, "hello: process must not be empty"),
    (hello(), {"process": "x" * 65}, "hello: process must be a text of at most 64 characters, got"),
    (hello(), {"first": 0}, f"hello: first {INTEGER} 1 and {MAX_INTEGER}, got 0"),
    (hello(), {"fingerprints": "x"}, "hello: fingerprints must be a map, got 'x'"),
    (hello(), {"fingerprints": {"A": "x"}}, "hello: fingerprints: a name is 1 to 64 characters"),
    (hello(), {"fingerprints": {"a": 1}}, "hello: fingerprints.a must be a text of at most 64 ch"),
    (hello(), {"first": None}, "hello: the field first is missing"),
    (hello(), {"more": 1}, "hello: unknown field 'more'"),
    (WantWeights("e", 3), {"version": -2}, f"want_weights: version {INTEGER} -1 and"),
    (WantWeights("e", 3), {"epoch": 3}, "want_weights: epoch must be a text of at most 64 chara"),
    (Heartbeat({}), {"stats": {"a": NAN}}, "heartbeat: stats.a must be a finite number, got nan"),
    (Heartbeat({}), {"stats": {"A": 1}}, "heartbeat: stats: a name is 1 to 64 characters of"),
    (Bye("x"), {"reason": 1}, "bye: reason must be a text of at most 1024 characters, got 1"),
    (Bye("x"), {"kind": "welcome"}, "unknown kind of message 'welcome'"),
    (Bye("x"), {"kind": "\x1b[0m"}, r"unknown kind of message '\x1b[0m'"),
]


@pytest.mark.parametrize(("message", "changes", "reason"), FROM_WORKER)
def test_wrong_fields_from_workers_are_named(
    message: Plain, changes: dict[str, Any], reason: str
) -> None:
    with pytest.raises(WireError) as caught:
        decode_from_worker(with_header(message.encode(), **changes), SPEC)
    assert str(caught.value).startswith(reason)


WELCOME = Welcome("e", "run", 1, 0, 1, "tcp://h:1", 4, False)
GO = Go(number=3, version=7, first_episode=96, episodes=32)
REJECT = Reject(reason="x", sequence=1, final=True)

FROM_MASTER: list[tuple[Plain, dict[str, Any], str]] = [
    (WELCOME, {"epoch": "x" * 65}, "welcome: epoch must be a text of at most 64 characters, got"),
    (WELCOME, {"run_id": "x" * 257}, "welcome: run_id must be a text of at most 256 characters"),
    (WELCOME, {"seed": -1}, f"welcome: seed {INTEGER} 0 and {MAX_INTEGER}, got -1"),
    (WELCOME, {"index": -1}, f"welcome: index {INTEGER} 0 and 65535, got -1"),
    (WELCOME, {"incarnation": 0}, f"welcome: incarnation {INTEGER} 1 and {MAX_INTEGER}, got 0"),
    (WELCOME, {"weights_endpoint": 5}, "welcome: weights_endpoint must be a text of at most 256"),
    (WELCOME, {"window": 0}, f"welcome: window {INTEGER} 1 and 1024, got 0"),
    (WELCOME, {"window": 1025}, f"welcome: window {INTEGER} 1 and 1024, got 1025"),
    (WELCOME, {"lockstep": 0}, "welcome: lockstep must be true or false, got 0"),
    (GO, {"number": -1}, f"go: number {INTEGER} 0 and {MAX_INTEGER}, got -1"),
    (GO, {"version": -2}, f"go: version {INTEGER} -1 and {MAX_INTEGER}, got -2"),
    (GO, {"first_episode": -1}, f"go: first_episode {INTEGER} 0 and {MAX_INTEGER}, got -1"),
    (GO, {"episodes": 4097}, f"go: episodes {INTEGER} 1 and 4096, got 4097"),
    (Ack(1, duplicate=False), {"sequence": 0}, f"ack: sequence {INTEGER} 1 and {MAX_INTEGER}"),
    (Ack(1, duplicate=False), {"duplicate": 0}, "ack: duplicate must be true or false, got 0"),
    (REJECT, {"sequence": -1}, f"reject: sequence {INTEGER} 0 and {MAX_INTEGER}, got -1"),
    (REJECT, {"final": None}, "reject: the field final is missing"),
    (REJECT, {"reason": 1}, "reject: reason must be a text of at most 1024 characters, got 1"),
    (Alive(1), {"version": -2}, f"alive: version {INTEGER} -1 and {MAX_INTEGER}, got -2"),
    (Stop("x"), {"reason": {}}, "stop: reason must be a text of at most 1024 characters, got a di"),
    (Refused("x"), {"reason": 1}, "refused: reason must be a text of at most 1024 characters, go"),
    (Greet(), {"more": 1}, "greet: unknown field 'more'"),
    (Greet(), {"kind": "hello"}, "unknown kind of message 'hello'"),
    (Greet(), {"kind": "weights"}, "weights: there must be 2 frames, got 1"),
]


@pytest.mark.parametrize(("message", "changes", "reason"), FROM_MASTER)
def test_wrong_fields_from_the_master_are_named(
    message: Plain, changes: dict[str, Any], reason: str
) -> None:
    with pytest.raises(WireError) as caught:
        decode_from_master(with_header(message.encode(), **changes), SHAPES)
    assert str(caught.value).startswith(reason)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"count": 0}, f"episodes: count {INTEGER} 1 and {SPEC.max_count}, got 0"),
        ({"count": 4097}, f"episodes: count {INTEGER} 1 and {SPEC.max_count}, got 4097"),
        ({"count": 2}, "corners must have 560 bytes for the shape (2, 5, 7, 2), got 840"),
        ({"weights_version": -2}, f"episodes: weights_version {INTEGER} -1 and {MAX_INTEGER}"),
        ({"more": 1}, "episodes: unknown field 'more'"),
    ],
)
def test_a_wrong_batch_is_refused_with_its_number(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(BatchError) as caught:
        decode_from_worker(with_header(batch(sequence=9).encode(SPEC), **changes), SPEC)
    assert str(caught.value).startswith(reason)
    assert caught.value.sequence == 9


@pytest.mark.parametrize("sequence", [0, -1, 2**63, "1", None])
def test_a_batch_without_a_number_is_no_batch(sequence: object) -> None:
    with pytest.raises(WireError, match=r"episodes: .*sequence") as caught:
        decode_from_worker(with_header(batch().encode(SPEC), sequence=sequence), SPEC)
    assert not isinstance(caught.value, BatchError)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"count": 65}, f"scores: count {INTEGER} 0 and 64, got 65"),
        ({"count": 1}, "starts must have 56 bytes for the shape (1, 7, 2), got 112"),
        ({"scalars": {"a": NAN}}, "scores: scalars.a must be a finite number, got nan"),
        ({"scalars": {"a b": 1}}, "scores: scalars: a name is 1 to 64 characters of"),
        ({"weights_version": "1"}, f"scores: weights_version {INTEGER} -1 and {MAX_INTEGER}, got"),
        ({"more": 1}, "scores: unknown field 'more'"),
    ],
)
def test_wrong_scores_are_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(WireError) as caught:
        decode_from_worker(with_header(scores().encode(SPEC), **changes), SPEC)
    assert str(caught.value).startswith(reason)


@pytest.mark.parametrize(
    ("number", "name", "value"), [(1, "starts", NAN), (2, "ends", 4.5), (3, "goals", -4.5)]
)
def test_pictures_out_of_bounds_are_refused(number: int, name: str, value: float) -> None:
    frames = scores().encode(SPEC)
    array = np.frombuffer(frames[number], "<f4").copy()
    array[-1] = value
    frames[number] = array.tobytes()
    with pytest.raises(WireError, match=rf"{name} holds {value:g} at \[1, 6, 1\]"):
        decode_from_worker(frames, SPEC)


def test_wrong_scores_and_stats_are_not_sent() -> None:
    sent = scores()
    with pytest.raises(WireError, match="scores: at most 64 test episodes, got 65"):
        scores(65).encode(SPEC)
    with pytest.raises(WireError, match="scores: a must be a finite number, got nan"):
        Scores(1, {"a": NAN}, sent.starts, sent.ends, sent.goals).encode(SPEC)
    with pytest.raises(WireError, match=r"ends must have the shape \(2, 7, 2\), got \(1, 7, 2\)"):
        Scores(1, {}, sent.starts, sent.ends[:1], sent.goals).encode(SPEC)
    with pytest.raises(WireError, match="heartbeat: a must be a finite number, got inf"):
        Heartbeat({"a": float("inf")}).encode()


def test_an_empty_message_and_extra_frames_are_refused() -> None:
    for decode, message in ((decode_from_worker, Bye("x")), (decode_from_master, Stop("x"))):
        with pytest.raises(WireError, match="the message is empty"):
            decode([], None)  # type: ignore[operator]
        with pytest.raises(WireError, match=f"{message.kind}: there must be 1 frame, got 2"):
            decode([*message.encode(), b""], None)  # type: ignore[operator]
    with pytest.raises(WireError, match="weights: there must be 2 frames, got 3"):
        decode_from_master([*WeightsMessage.wrap(b""), b""], SHAPES)
    with pytest.raises(BatchError, match="there must be 5 array frames, got 6"):
        decode_from_worker([*batch().encode(SPEC), b""], SPEC)
    with pytest.raises(WireError, match="there must be 3 array frames, got 2"):
        decode_from_worker(scores().encode(SPEC)[:-1], SPEC)


def test_another_protocol_is_told_from_garbage() -> None:
    for frames in (hello().encode(), batch().encode(SPEC)):
        with pytest.raises(ProtocolError, match=f"speaks protocol {PROTOCOL + 1}, this one"):
            decode_from_worker(with_header(frames, v=PROTOCOL + 1), SPEC)
    with pytest.raises(ProtocolError, match="install the same version of tangram on both"):
        decode_from_master(with_header(WELCOME.encode(), v=0), None)


def test_the_size_of_a_header_is_checked_before_it_is_unpacked() -> None:
    frame = msgpack.packb({"v": PROTOCOL, "kind": "bye", "reason": "x" * MAX_HEADER})
    with pytest.raises(WireError, match=f"the header has {len(frame)} bytes, at most {MAX_HEADER}"):
        decode_from_worker([frame], SPEC)


def test_all_kinds_are_in_the_round_trips() -> None:
    """A new message must be added above."""
    drawn = {Hello, WantWeights, Heartbeat, Bye, AskStatus}
    drawn |= {Welcome, Go, Refused, Greet, Ack, Reject, Alive, Stop}
    kinds = {
        kind for parent in (Plain, *Plain.__subclasses__()) for kind in parent.__subclasses__()
    }
    assert {kind for kind in kinds if hasattr(kind, "kind")} == drawn
    assert asdict(Greet()) == {}


@given(st.lists(st.binary(max_size=100), max_size=7))
def test_random_frames_raise_nothing_but_wire_errors(frames: list[bytes]) -> None:
    for decode in (
        lambda: decode_from_worker(frames, SPEC),
        lambda: decode_from_master(frames, SHAPES),
    ):
        with pytest.raises(WireError):
            decode()


GENUINE = [
    hello().encode(),
    batch().encode(SPEC),
    scores().encode(SPEC),
    Heartbeat({"a": 1.0}).encode(),
    WELCOME.encode(),
    REJECT.encode(),
    WeightsMessage.wrap(encode_weights("e", weights())),
]


@given(st.sampled_from(GENUINE), st.data())
def test_mutated_messages_raise_nothing_but_wire_errors(
    frames: list[bytes], data: st.DataObject
) -> None:
    mutated = list(frames)
    number = data.draw(st.integers(0, len(frames) - 1))
    frame = frames[number]
    start = data.draw(st.integers(0, len(frame)))
    end = data.draw(st.integers(start, min(len(frame), start + 8)))
    mutated[number] = frame[:start] + data.draw(st.binary(max_size=8)) + frame[end:]
    for decode in (
        lambda: decode_from_worker(mutated, SPEC),
        lambda: decode_from_master(mutated, SHAPES),
    ):
        with suppress(WireError):
            decode()
