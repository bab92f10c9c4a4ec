"""Arrays and weights on the wire: exact sizes, bounds on every value, names of what is wrong."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.numpy import save

from tangram_core.errors import ConfigError, WireError
from tangram_core.spec import Episodes, EpisodeSpec, Field
from tangram_core.wire import arrays
from tangram_core.wire.arrays import (
    MAX_BATCH_BYTES,
    MAX_EPISODES,
    MAX_FRAME_BYTES,
    MAX_FRAMES,
    check_batch_size,
    columns,
    decode_columns,
    decode_tensors,
    encode_columns,
    encode_tensors,
    join_frames,
    most_episodes,
    split_frames,
)
from tangram_sim.config import RewardConfig
from tests.agent.builders import BFLOAT, one_tensor, setup
from tests.agent.messages import BOUND, SHAPES, SPEC, episodes, weights

pytestmark = pytest.mark.fast

NAMES = ("corners", "placed", "goals", "actions", "rewards", "terminated")
NAN, INF = float("nan"), float("inf")


def encode_episodes(sent: Episodes, spec: EpisodeSpec) -> list[bytes]:
    return encode_columns(sent.arrays, columns(spec, sent.count))


def decode_episodes(frames: list[bytes], count: int, spec: EpisodeSpec) -> Episodes:
    return Episodes(decode_columns(frames, columns(spec, count)))


def same(left: Episodes, right: Episodes) -> bool:
    return all(np.array_equal(left[name], right[name]) for name in NAMES)


@st.composite
def tasks(draw: st.DrawFn) -> tuple[EpisodeSpec, Episodes]:
    """A task and episodes within its bounds."""
    horizon, size, rows = (draw(st.integers(1, 4)) for _ in range(3))
    bound, count = draw(st.floats(0.5, 100)), draw(st.integers(1, 3))
    fields = (
        Field("corners", (rows, 2), -bound, bound),
        Field("placed", (rows,), 0, 1, "moment", "u1"),
        Field("goals", (rows, 2), -bound, bound, "episode"),
    )
    spec = EpisodeSpec(horizon, size, fields, "corners", "goals")
    arrays = {}
    for column in columns(spec, count):
        low, high = column.bounds
        flags, numbers = st.integers(0, 1), st.floats(low, high, width=32)
        elements = flags if column.native == np.uint8 else numbers
        arrays[column.name] = draw(hnp.arrays(column.native, column.shape, elements=elements))
    return spec, Episodes(arrays)


@given(tasks())
def test_episodes_come_back_as_they_were_sent(task: tuple[EpisodeSpec, Episodes]) -> None:
    spec, sent = task
    received = decode_episodes(encode_episodes(sent, spec), sent.count, spec)
    assert same(sent, received)
    kinds = ["<f4", "|u1", "<f4", "<f4", "<f4", "|u1"]
    assert [received[name].dtype.str for name in NAMES] == kinds


def test_frames_are_raw_little_endian_bytes_in_the_order_of_the_fields() -> None:
    sent = episodes(2)
    frames = encode_episodes(sent, SPEC)
    sizes = [2 * 5 * 7 * 2 * 4, 2 * 5 * 2, 2 * 7 * 2 * 4, 2 * 4 * 4 * 4, 2 * 4 * 4, 2 * 4]
    assert [len(frame) for frame in frames] == sizes
    assert frames == [sent[name].tobytes() for name in NAMES]


def test_decoding_copies_nothing() -> None:
    frames = encode_episodes(episodes(2), SPEC)
    for array, frame in zip(decode_episodes(frames, 2, SPEC).arrays.values(), frames, strict=True):
        assert np.shares_memory(array, np.frombuffer(frame, np.uint8))
        assert not array.flags.writeable


def test_other_memory_orders_and_dtypes_are_sent_as_what_they_mean() -> None:
    sent = episodes(2)
    wide = np.asfortranarray(sent["corners"].astype(np.float64))
    odd = Episodes({**sent.arrays, "corners": wide})
    assert encode_episodes(odd, SPEC) == encode_episodes(sent, SPEC)
    matrix = np.arange(6, dtype=np.float32).reshape(2, 3)
    received = decode_tensors(encode_tensors({"a": matrix.T}), {"a": (3, 2)})
    assert np.array_equal(received["a"], matrix.T)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", [-1, 1, None])
def test_each_frame_has_its_exact_size(name: str, change: int | None) -> None:
    frames = encode_episodes(episodes(2), SPEC)
    number = NAMES.index(name)
    size = len(frames[number])
    frames[number] = b"" if change is None else (frames[number] + b"\0")[: size + change]
    told = f"{name} must have {size} bytes for the shape {columns(SPEC, 2)[number].shape}, got "
    with pytest.raises(WireError, match=f"^{re.escape(told)}{len(frames[number])}$"):
        decode_episodes(frames, 2, SPEC)


BOUNDED: dict[str, tuple[str, str, list[float]]] = {
    "corners": ("[1, 0, 0, 0]", "-4 and 4", [NAN, INF, -INF, 4.001, -4.001]),
    "goals": ("[1, 0, 0]", "-4 and 4", [NAN, 4.001]),
    "placed": ("[1, 0, 0]", "0 and 1", [2, 255]),
    "actions": ("[1, 0, 0]", "-1 and 1", [NAN, 1.00001, -1.00001]),
    "rewards": ("[1, 0]", "-1 and 1", [NAN, INF, 1.1, -1.1]),
}
BAD_VALUES = [(name, value) for name, (*_, values) in BOUNDED.items() for value in values]


def spoiled(name: str, value: float) -> Episodes:
    sent = episodes(2)
    array = sent[name].copy()
    array[(1, *[0] * (array.ndim - 1))] = value
    return Episodes({**sent.arrays, name: array})


@pytest.mark.parametrize(("name", "value"), BAD_VALUES)
def test_values_out_of_bounds_are_named(name: str, value: float) -> None:
    bad, (place, bounds, _) = spoiled(name, value), BOUNDED[name]
    told = f"{name} holds {value:g} at {place}, must be finite and between {bounds}"
    with pytest.raises(WireError, match=f"^{re.escape(told)}"):
        decode_episodes([bad[n].tobytes() for n in NAMES], 2, SPEC)
    with pytest.raises(WireError, match=f"^{re.escape(told)}"):
        encode_episodes(bad, SPEC)


@pytest.mark.parametrize(
    ("name", "value"),
    [("corners", BOUND), ("goals", -BOUND), ("actions", 1 + 5e-7), ("rewards", -1.0)],
)
def test_values_at_their_bounds_pass(name: str, value: float) -> None:
    sent = spoiled(name, value)
    assert same(decode_episodes(encode_episodes(sent, SPEC), 2, SPEC), sent)


@pytest.mark.parametrize("reward", ["overlap", "dense"])
def test_a_run_takes_no_reward_that_its_own_cannot_be(reward: str) -> None:
    """Episodes of 1e6 among thousands spoilt for good what a critic had learned."""
    spec = replace(setup().task, reward=RewardConfig(reward)).spec
    (column,) = [one for one in columns(spec, 1) if one.name == "rewards"]
    worst = np.full(column.shape, spec.rewards[0], np.float32)
    assert -1.5 < spec.rewards[0] <= -1.0
    for value in (worst, np.ones_like(worst)):
        assert np.array_equal(column.decode(column.encode(value)), value)
    for value in (worst * 1.01, np.full_like(worst, 1.01)):
        with pytest.raises(WireError, match=r"rewards holds .* must be finite and between -1"):
            column.decode(value.tobytes())


def spec_of(rows: int, horizon: int) -> EpisodeSpec:
    """Of episodes with so many corners and steps."""
    fields = (
        Field("corners", (rows, 2), -BOUND, BOUND),
        Field("goals", (rows, 2), -BOUND, BOUND, "episode"),
    )
    return EpisodeSpec(horizon, 4, fields, "corners", "goals")


def test_large_arrays_are_cut_and_put_together_again() -> None:
    large = spec_of(28, 50)
    rng = np.random.default_rng(0)
    for count in (1, 2, 3, most_episodes(large)):
        arrays = {
            c.name: rng.uniform(c.low, c.high, c.shape).astype(c.native)
            for c in columns(large, count)
        }
        sent = Episodes(arrays)
        frames = encode_episodes(sent, large)
        assert max(map(len, frames)) <= MAX_FRAME_BYTES
        assert len(frames) <= MAX_FRAMES
        assert [len(f) for f in frames[: count // 3]] == [MAX_FRAME_BYTES] * (count // 3)
        found = decode_episodes(frames, count, large)
        assert all(np.array_equal(found[name], array) for name, array in arrays.items())
        for wrong in (frames[1:], [*frames, b""], [frames[0][:-1], *frames[1:]]):
            with pytest.raises(WireError):
                decode_episodes(wrong, count, large)


def test_a_batch_holds_a_bounded_number_of_episodes() -> None:
    long = spec_of(64, 500)
    each = 4 * (501 * 128 + 500 * 5 + 128) + 500
    assert most_episodes(long) == MAX_BATCH_BYTES // each == 7
    assert most_episodes(spec_of(3, 1)) == MAX_EPISODES
    check_batch_size(long, 7)
    message = (
        f"8 episodes of 500 steps, {each:,} bytes each, are too many for one message, at most 7: "
        "lower service.envs, or shorten the episodes"
    )
    with pytest.raises(ConfigError, match=f"^{message}$"):
        check_batch_size(long, 8)
    with pytest.raises(ConfigError, match=r"1 episodes of 100000 steps.* at most 0: lower"):
        check_batch_size(spec_of(64, 100_000))


names = st.text(min_size=1, max_size=8)
tensors = hnp.arrays(
    np.float32,
    hnp.array_shapes(min_dims=0, max_dims=3, max_side=4),
    elements=st.floats(-1e6, 1e6, width=32),
)


@given(st.dictionaries(names, tensors, min_size=1, max_size=4))
def test_tensors_come_back_as_they_were_sent(sent: dict[str, Any]) -> None:
    shapes = {name: tensor.shape for name, tensor in sent.items()}
    received = decode_tensors(encode_tensors(sent), shapes)
    assert {n: t.shape for n, t in received.items()} == shapes
    assert all(np.array_equal(t, sent[n]) for n, t in received.items())


def tensor_frame(**arrays: Any) -> bytes:
    good = {name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()}
    given_arrays = {name.replace("__", "."): array for name, array in arrays.items()}
    return save({n: t for n, t in (good | given_arrays).items() if t is not None})


DATA = save({name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()})
HUGE_HEADER = (10**15).to_bytes(8, "little") + b"{}"


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (b"", "not safetensors: "),
        (DATA[:-1], "not safetensors: "),
        (DATA + b"\0", "not safetensors: "),
        (HUGE_HEADER, "not safetensors: "),
        (b"\x80\x04N.", "not safetensors: "),  # a pickle
        (tensor_frame(actor__bias=np.zeros(4, np.float32)), "'actor.bias' must be (3,), got (4,)"),
        (tensor_frame(actor__bias=None), "'actor.bias' must be (3,), got none"),
        (tensor_frame(other=np.zeros(4, np.float32)), "'other' must be no such tensor, got (4,)"),
        (tensor_frame(scale=np.zeros((), np.float64)), "'scale' must be float32, got flo"),
        (tensor_frame(scale=np.array(NAN, np.float32)), "'scale' is not finite"),
        (tensor_frame(scale=np.array(INF, np.float32)), "'scale' is not finite"),
        (BFLOAT, "not safetensors: 'BF16'"),
        (one_tensor("F32", [1] * 70), "not safetensors: maximum "),
    ],
)
def test_wrong_tensors_are_refused(frame: bytes, reason: str) -> None:
    with pytest.raises(WireError, match=f"^{re.escape(f'weights: {reason}')}"):
        decode_tensors(frame, SHAPES)


def test_tensors_of_any_shape_pass_where_none_is_expected() -> None:
    assert decode_tensors(tensor_frame(), None).keys() == SHAPES.keys()
    with pytest.raises(WireError, match="'scale' is not finite"):
        decode_tensors(tensor_frame(scale=np.array(NAN, np.float32)), None)


@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_tensors_that_are_not_finite_are_not_sent(value: float) -> None:
    bad = weights().tensors
    bad["actor.bias"][1] = value
    with pytest.raises(WireError, match=r"weights: 'actor.bias' is not finite"):
        encode_tensors(bad)


def test_weights_too_large_to_be_received_are_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "MAX_WEIGHTS_BYTES", 4000)
    with pytest.raises(WireError, match=r"weights: .* bytes, at most 4000: choose a smaller net"):
        encode_tensors({"a": np.zeros(1000, np.float32)})
    with pytest.raises(WireError, match="weights: 4001 bytes, at most 4000"):
        decode_tensors(bytes(4001), SHAPES)


@given(st.binary(max_size=300))
def test_random_data_raise_nothing_but_wire_errors(data: bytes) -> None:
    with pytest.raises(WireError):
        decode_tensors(data, SHAPES)


@given(st.integers(0, len(DATA) - 1), st.integers(0, 255))
def test_mutated_tensors_raise_nothing_but_wire_errors(position: int, byte: int) -> None:
    try:
        received = decode_tensors(DATA[:position] + bytes([byte]) + DATA[position + 1 :], SHAPES)
    except WireError:
        return
    assert {n: t.shape for n, t in received.items()} == SHAPES


@given(st.lists(st.binary(max_size=20), max_size=MAX_FRAMES))
def test_joined_frames_come_back_and_none_that_is_cut_short(frames: list[bytes]) -> None:
    data = join_frames(frames)
    assert split_frames(data) == frames
    ends = {len(join_frames(frames[:number])) for number in range(len(frames) + 1)}
    for size in set(range(len(data))) - ends:
        with pytest.raises(WireError, match="joined frames is cut short"):
            split_frames(data[:size])


def test_joined_frames_are_those_of_a_message_with_its_header_and_no_more() -> None:
    whole = [b""] * (1 + MAX_FRAMES)
    assert split_frames(join_frames(whole)) == whole
    with pytest.raises(WireError, match=f"there may be {MAX_FRAMES + 1} joined frames, got more"):
        split_frames(join_frames([*whole, b""]))
