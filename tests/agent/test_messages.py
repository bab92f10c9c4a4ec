"""Messages: each comes back as it was sent, and each field that is wrong is named."""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tangram_core.agent import Weights
from tangram_core.errors import WireError
from tangram_core.wire.arrays import most_episodes
from tangram_core.wire.messages import (
    MAX_ROWS,
    PICTURE_WIDTH,
    ROLES,
    WORKER_COLUMNS,
    Ack,
    Alive,
    AskStatus,
    BatchError,
    Bye,
    EpisodeBatch,
    Go,
    Greet,
    Heartbeat,
    Refused,
    Reject,
    RunStatus,
    Scores,
    Stop,
    ToMaster,
    ToWorker,
    WantWeights,
    WeightsMessage,
    Welcome,
    decode_from_master,
    decode_from_worker,
    decode_weights,
)
from tangram_core.wire.schema import (
    PROTOCOL,
    Between,
    Bound,
    Flag,
    Message,
    Numbers,
    ProtocolError,
    Text,
    Texts,
    by_kind,
)
from tests.agent.messages import (
    SHAPES,
    SPEC,
    batch,
    broadcast,
    episodes,
    hello,
    scores,
    weights,
    with_checksum,
    with_header,
)

pytestmark = pytest.mark.fast

NAN = float("nan")
BIG = 2**53
INTEGER = "must be an integer between"
COLUMNS = len(WORKER_COLUMNS)

# What each field may hold, written down a second time: a bound that is loosened by mistake, and a
# field that nobody thought of, are found here.
REASON = {"reason": Text(1024, cut=True)}
BOUNDS: dict[str, dict[str, Bound]] = {
    "hello": {
        "role": Text(1024, choices=("player", "evaluator")),
        "index": Between(-1, 65_535),
        "incarnation": Between(0, BIG),
        "process": Text(64, needed=True),
        "first": Between(1, BIG),
        "fingerprints": Texts(64),
        "run_id": Text(256),
    },
    "want_weights": {"epoch": Text(64), "version": Between(-1, BIG)},
    "heartbeat": {"stats": Numbers(lenient=True)},
    "bye": REASON,
    "ask_status": {},
    "episodes": {"sequence": Between(1, BIG), "weights_version": Between(-1, BIG)},
    "scores": {"weights_version": Between(-1, BIG), "scalars": Numbers()},
    "welcome": {
        "epoch": Text(64),
        "run_id": Text(256),
        "seed": Between(0, 2**63 - 1),
        "index": Between(0, 65_535),
        "incarnation": Between(1, BIG),
        "weights_endpoint": Text(256),
        "window": Between(1, 1024),
        "lockstep": Flag(),
    },
    "go": {
        "number": Between(0, BIG),
        "version": Between(-1, BIG),
        "first_episode": Between(0, BIG),
        "episodes": Between(1, 4096),
    },
    "refused": {**REASON, "later": Flag()},
    "greet": {},
    "ack": {"sequence": Between(1, BIG), "duplicate": Flag()},
    "reject": {**REASON, "sequence": Between(0, BIG), "final": Flag()},
    "alive": {"version": Between(-1, BIG)},
    "stop": REASON,
    "weights": {"epoch": Text(64)},
    "status": {"numbers": Numbers(lenient=True), "texts": Texts(1024, lenient=True)},
}
KINDS = by_kind(ToMaster) | by_kind(ToWorker)


def test_every_field_of_every_message_has_its_bound() -> None:
    assert {kind: dict(cls.bounds) for kind, cls in KINDS.items()} == BOUNDS
    arrays = {"episodes", "picture", "weights", "workers"}
    for cls in KINDS.values():
        assert {f.name for f in fields(cls)} <= cls.bounds.keys() | arrays  # type: ignore[arg-type]


def status(rows: int = 3, **more: Any) -> RunStatus:
    table = np.arange(rows * COLUMNS, dtype=np.float64).reshape(rows, COLUMNS)
    given_fields = {"numbers": {"updates": 7.0, "hub/batches": 2.0}, "texts": {"run": "é"}, **more}
    return RunStatus(workers=table, **given_fields)


EXAMPLES: dict[str, list[bytes]] = {
    "hello": hello().encode(),
    "want_weights": WantWeights("e", 3).encode(),
    "heartbeat": Heartbeat({"a": 1.0}).encode(),
    "bye": Bye("x").encode(),
    "ask_status": AskStatus().encode(),
    "episodes": batch(9).encode(SPEC),
    "scores": scores().encode(SPEC),
    "welcome": Welcome("e", "run", 1, 0, 1, "tcp://h:1", 4, False).encode(),
    "go": Go(number=3, version=7, first_episode=96, episodes=32).encode(),
    "refused": Refused("x").encode(),
    "greet": Greet().encode(),
    "ack": Ack(1, duplicate=False).encode(),
    "reject": Reject(reason="x", sequence=1, final=True).encode(),
    "alive": Alive(1).encode(),
    "stop": Stop("x").encode(),
    "weights": WeightsMessage("e", weights()).encode(),
    "status": status().encode(),
}


def decode(frames: Sequence[bytes], kind: str) -> Message:
    if kind in by_kind(ToMaster):
        return decode_from_worker(frames, SPEC)
    return decode_from_master(frames, SHAPES)


DESCRIBED = {
    "episodes": ["count"],
    "scores": ["count"],
    "status": ["count"],
    "weights": ["version"],
}
FIELDS = [(kind, name) for kind in BOUNDS for name in (*BOUNDS[kind], *DESCRIBED.get(kind, ()))]


@pytest.mark.parametrize(("kind", "name"), FIELDS)
def test_each_field_is_refused_out_of_its_bound_and_where_it_is_missing(
    kind: str, name: str
) -> None:
    """What each bound refuses stands in test_schema.py; 0.5 is out of every one."""
    for value, told in ((0.5, "must "), ({"A": 1}, "(must|a name is) ")):
        with pytest.raises(WireError, match=f"^{kind}: {name}.*{told}") as caught:
            decode(with_header(EXAMPLES[kind], **{name: value}), kind)
        assert isinstance(caught.value, BatchError) == (kind == "episodes" and name != "sequence")
    with pytest.raises(WireError, match=f"{kind}: the field {name} is missing"):
        decode(with_header(EXAMPLES[kind], **{name: None}), kind)


@pytest.mark.parametrize("kind", BOUNDS)
def test_a_field_or_a_frame_too_many_or_another_kind_is_refused(kind: str) -> None:
    frames = EXAMPLES[kind]
    with pytest.raises(WireError, match=f"{kind}: unknown field 'more'"):
        decode(with_header(frames, more=1), kind)
    with pytest.raises(WireError, match=r"there must be \d+ (array )?frame"):
        decode(with_checksum([*frames, b""]), kind)
    with pytest.raises(ProtocolError, match=f"speaks protocol {PROTOCOL + 1}, this one"):
        decode(with_header(frames, v=PROTOCOL + 1), kind)
    for name in ("other", "\x1b[0m"):
        with pytest.raises(WireError, match=f"^{re.escape(f'unknown kind of message {name!r}')}$"):
            decode(with_header(frames, kind=name), kind)
    with pytest.raises(WireError, match=f"unknown kind of message '{kind}'"):
        decode(frames, "welcome" if kind in by_kind(ToMaster) else "hello")


words = st.text("abc_./9", min_size=1, max_size=64)


def values_of(bound: Bound) -> st.SearchStrategy[Any]:
    """What a field may hold."""
    match bound:
        case Between(low, high):
            return st.integers(low, high)
        case Flag():
            return st.booleans()
        case Text(longest, choices, needed):
            letters = st.characters().filter(str.isprintable)
            text = st.text(letters, min_size=int(needed), max_size=min(longest, 200))
            return st.sampled_from(sorted(choices)) if choices else text
        case Numbers():
            keys = words
            return st.dictionaries(keys, st.floats(-1e18, 1e18), max_size=5)
        case Texts():
            return st.dictionaries(words, st.text("é9", min_size=1, max_size=16), max_size=5)
    raise AssertionError(bound)


plain = st.sampled_from([c for k, c in KINDS.items() if k not in DESCRIBED]).flatmap(
    lambda cls: st.builds(cls, **{name: values_of(b) for name, b in cls.bounds.items()})
)


@given(plain)
def test_plain_messages_come_back_as_they_were_sent(message: Message) -> None:
    assert decode(message.encode(), message.kind) == message


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (kind, name)
        for kind, bounds in BOUNDS.items()
        for name, bound in bounds.items()
        if isinstance(bound, Text | Texts) and not getattr(bound, "choices", ())
    ],
)
def test_no_text_of_a_peer_has_what_a_terminal_obeys(kind: str, name: str) -> None:
    """Status, logs and errors print them."""
    wild = "a\x1b[2J\n\u202eb\udcff".encode("utf-8", "surrogatepass")
    given: Any = wild.decode("utf-8", "replace")
    if isinstance(BOUNDS[kind][name], Texts):
        given = {"task": given}
    found = getattr(decode(with_header(EXAMPLES[kind], **{name: given}), kind), name)
    text = found["task"] if isinstance(given, dict) else found
    assert text.startswith("a\\x1b[2J\\n\\u202eb")
    assert text.isprintable()


@given(st.integers(1, BIG), st.integers(-1, BIG), st.integers(1, 5), st.integers(0, 99))
def test_batches_come_back_as_they_were_sent(
    sequence: int, version: int, count: int, seed: int
) -> None:
    sent = EpisodeBatch(sequence, version, episodes(count, seed))
    received = decode_from_worker(sent.encode(SPEC), SPEC)
    assert isinstance(received, EpisodeBatch)
    assert (received.sequence, received.weights_version) == (sequence, version)
    for name, array in sent.episodes.arrays.items():
        np.testing.assert_array_equal(received.episodes[name], array)


@given(st.integers(0, 9), values_of(Numbers()), st.integers(-1, BIG))
def test_scores_come_back_as_they_were_sent(
    count: int, scalars: dict[str, float], version: int
) -> None:
    drawn = np.random.default_rng(count).integers(0, 256, (count, PICTURE_WIDTH, 3))
    sent = Scores(version, scalars, drawn.astype(np.uint8))
    received = decode_from_worker(sent.encode(SPEC), SPEC)
    assert isinstance(received, Scores)
    assert (received.weights_version, received.scalars) == (version, scalars)
    np.testing.assert_array_equal(received.picture, sent.picture)


@pytest.mark.parametrize("rows", [0, 3])
def test_a_status_comes_back_as_it_was_sent(rows: int) -> None:
    sent = status(rows)
    found = decode_from_master(sent.encode(), None)
    assert isinstance(found, RunStatus)
    assert (found.numbers, found.texts) == (sent.numbers, sent.texts)
    np.testing.assert_array_equal(found.workers, sent.workers)


def test_a_status_is_always_sent_whatever_it_says() -> None:
    """The loop of a run must not end because of what it tells."""
    numbers = {f"n{i}": 0.0 for i in range(70)} | {"Bad name": 1.0}
    odd = {"a": NAN, "b": float("inf"), **numbers}
    texts = {f"t{i}": "é" * 5000 for i in range(70)} | {"Bad name": "x", "lone": "\ud800"}
    table = np.full((MAX_ROWS + 5, COLUMNS), [NAN, -np.inf, np.inf, -2, 2e18, 1, 2, 3, 4])
    found = decode_from_master(RunStatus(odd, texts, table).encode(), None)
    assert isinstance(found, RunStatus)
    assert found.numbers == {"b": 1e18} | {f"n{i}": 0.0 for i in range(63)}
    assert 0 < len(found.texts["t0"]) <= 512
    assert found.workers.tolist() == [[-1, -1, 1e18, -1, 1e18, 1, 2, 3, 4]] * MAX_ROWS
    stats = decode_from_worker(Heartbeat(odd).encode(), SPEC)
    assert isinstance(stats, Heartbeat)
    assert stats.stats == found.numbers


@given(
    st.dictionaries(st.text(min_size=1, max_size=8), st.floats(-1e6, 1e6, width=32), min_size=1),
    st.integers(0, BIG),
)
def test_weights_come_back_as_they_were_sent(sent: dict[str, float], version: int) -> None:
    """As one frame for all, and as a message to one who asked."""
    tensors = {name: np.full((2, 1), value, np.float32) for name, value in sent.items()}
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(sent, (2, 1))
    epoch, received = decode_weights(broadcast(Weights(version, tensors)), shapes)
    message = decode_from_master(WeightsMessage("e", received).encode(), shapes)
    assert isinstance(message, WeightsMessage)
    assert (epoch, message.epoch, message.weights.version) == ("e", "e", version)
    assert all(np.array_equal(message.weights.tensors[n], t) for n, t in tensors.items())


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (b"", "the message is empty"),
        (broadcast(weights())[:-1], "frame 2 of joined frames is cut short"),
        (broadcast(weights(value=1.0))[:-1] + b"\xff", "the message is damaged: its"),
    ],
)
def test_a_broadcast_that_is_no_weights_is_refused(frame: bytes, reason: str) -> None:
    with pytest.raises(WireError, match=reason):
        decode_weights(frame, SHAPES)


def with_last(frames: list[bytes], number: int, value: float) -> list[bytes]:
    """The same message with another value at the end of an array."""
    array = np.frombuffer(frames[number], "<f4").copy()
    array[-1] = value
    return with_checksum([*frames[:number], array.tobytes(), *frames[number + 1 :]])


EPISODES, SCORES, STATUS = (EXAMPLES[kind] for kind in ("episodes", "scores", "status"))


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        (with_header(EPISODES, count=2), "corners must have 560 bytes for the shape (2, 5, 7, 2)"),
        (with_checksum(EPISODES[:-1]), "there must be 6 array frames, got 5"),
        (
            with_header(SCORES, count=1),
            "picture must have 3072 bytes for the shape (1, 1024, 3), got 6144",
        ),
        (with_last(EPISODES, 1, NAN), "corners holds nan at [2, 4, 6, 1]"),
        (with_last(EPISODES, 3, -4.5), "goals holds -4.5 at [2, 6, 1]"),
        (
            with_header(EPISODES, count=0),
            f"episodes: count {INTEGER} 1 and {most_episodes(SPEC)}, got 0",
        ),
        (with_header(EPISODES, count=most_episodes(SPEC) + 1), f"episodes: count {INTEGER} 1 and"),
        (with_header(SCORES, count=769), f"scores: count {INTEGER} 0 and 768, got 769"),
        (with_header(STATUS, count=4097), f"status: count {INTEGER} 0 and 4096, got 4097"),
        (with_header(STATUS, count=4), "workers must have 288 bytes for the shape (4, "),
        (
            with_checksum([STATUS[0], b"\xff" * 8 * 3 * COLUMNS]),
            "workers holds nan at [0, 0], must",
        ),
    ],
)
def test_arrays_that_are_not_what_their_header_says_are_refused(
    frames: list[bytes], reason: str
) -> None:
    with pytest.raises(WireError, match=f"^{re.escape(reason)}") as caught:
        decode(frames, "status" if b"status" in frames[0] else "episodes")
    if isinstance(caught.value, BatchError):
        assert caught.value.sequence == 9


@pytest.mark.parametrize("sequence", [0, -1, 2**53 + 1, 2**63, "1", True, None])
def test_a_batch_without_a_number_is_no_batch(sequence: object) -> None:
    with pytest.raises(WireError, match=r"episodes: .*sequence") as caught:
        decode_from_worker(with_header(batch().encode(SPEC), sequence=sequence), SPEC)
    assert not isinstance(caught.value, BatchError)


def test_what_a_receiver_would_refuse_is_not_sent() -> None:
    sent = scores()
    with pytest.raises(WireError, match=f"scores: count {INTEGER} 0 and 768, got 769"):
        scores(769).encode(SPEC)
    with pytest.raises(WireError, match=r"scores: scalars.iou must be a finite number, got nan"):
        replace(sent, scalars={"iou": NAN}).encode(SPEC)
    with pytest.raises(WireError, match=r"picture must have the shape \(2, 1024, 3\), got \(2, 9"):
        replace(sent, picture=sent.picture[:, :9]).encode(SPEC)
    none = episodes(1).at(slice(0))
    with pytest.raises(
        WireError, match=f"episodes: count {INTEGER} 1 and {most_episodes(SPEC)}, got 0"
    ):
        EpisodeBatch(1, 0, none).encode(SPEC)
    with pytest.raises(WireError, match=f"episodes: sequence {INTEGER} 1 and {BIG}, got 0"):
        batch(0).encode(SPEC)
    with pytest.raises(WireError, match=f"alive: version {INTEGER} -1 and {BIG}, got -2"):
        Alive(-2).encode()
    with pytest.raises(WireError, match=f"weights: version {INTEGER} 0 and {BIG}, got -1"):
        broadcast(weights(version=-1))


@pytest.mark.parametrize("kind", [Bye, Refused, Stop])
def test_reasons_are_cut_to_what_is_received(kind: type[Bye]) -> None:
    message = kind("\u20ac" * 5000)
    assert 0 < len(message.reason.encode()) <= 1024
    assert decode(message.encode(), message.kind) == message
    assert ROLES == ("player", "evaluator")


@given(st.sampled_from(sorted(EXAMPLES)), st.booleans(), st.data())
def test_mutated_messages_raise_nothing_but_wire_errors(
    kind: str, sealed: bool, data: st.DataObject
) -> None:
    mutated = list(EXAMPLES[kind])
    number = data.draw(st.integers(0, len(mutated) - 1))
    frame = mutated[number]
    start = data.draw(st.integers(0, len(frame)))
    end = data.draw(st.integers(start, min(len(frame), start + 8)))
    mutated[number] = frame[:start] + data.draw(st.binary(max_size=8)) + frame[end:]
    for other in ("hello", "welcome"):
        with suppress(WireError):
            decode(with_checksum(mutated) if sealed else mutated, other)
