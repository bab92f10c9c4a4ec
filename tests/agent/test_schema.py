"""Bounds, headers and checksums: what is not whole, small, flat and known is refused."""

import re
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tangram_core.errors import WireError
from tangram_core.wire.schema import (
    MAX_ENTRIES,
    MAX_HEADER,
    MAX_NUMBER,
    MAX_TEXT,
    MAX_TEXTS,
    PROTOCOL,
    Between,
    Bound,
    DamagedError,
    Flag,
    Message,
    Numbers,
    ProtocolError,
    Text,
    Texts,
    opened,
    plain,
    read,
    seal,
)
from tests.agent.messages import with_checksum

pytestmark = pytest.mark.fast

NAN, INF = float("nan"), float("inf")
NAMES = "a name is 1 to 64 characters of a-z, 0-9, _, . and /, got"
UNPACKED = "the header is not msgpack within the limits: "


@pytest.mark.parametrize(
    ("bound", "value", "reason"),
    [
        (Between(5, 9), 4, "must be an integer between 5 and 9, got 4"),
        (Between(5, 9), 10, "must be an integer between 5 and 9, got 10"),
        (Between(0, 9), True, "must be an integer between 0 and 9, got True"),
        (Between(5, 9), None, "must be an integer between 5 and 9, got None"),
        (Between(5, 9), "\x1b[31m", r"must be an integer between 5 and 9, got '\x1b[31m'"),
        (Between(5, 9), "x" * 50, f"must be an integer between 5 and 9, got '{'x' * 40}...'"),
        (Between(1), 2**53 + 1, f"must be an integer between 1 and {2**53}, got {2**53 + 1}"),
        (Flag(), 1, "must be true or false, got 1"),
        (Text(2), "abc", "must be a text of at most 2 characters, got 'abc'"),
        (Text(), 5, "must be a text of at most 1024 characters, got 5"),
        (Text(choices=("a", "b")), "c", "must be one of a, b, got 'c'"),
        (Text(needed=True), "", "must not be empty"),
        (Numbers(), 3, "must be a map, got 3"),
        (Numbers(), {"x": NAN}, "x must be a finite number, got nan"),
        (Numbers(), {"x": -INF}, "x must be a finite number, got -inf"),
        (Numbers(), {"x": True}, "x must be a finite number, got True"),
        (Numbers(), {"x": {}}, "x must be a finite number, got a dict"),
        (Numbers(), {"X": 1}, f"{NAMES} 'X'"),
        (Numbers(), {"": 1}, f"{NAMES} ''"),
        (Numbers(), {"x" * 65: 1}, f"{NAMES} '{'x' * 40}...'"),
        (Numbers(), {f"n{n}": 1.0 for n in range(65)}, "may have 64 entries, got 65"),
        (Texts(1), {"x": "ab"}, "x must be a text of at most 1 characters, got 'ab'"),
        (Texts(9), {"x": 3}, "x must be a text of at most 9 characters, got 3"),
    ],
)
def test_what_is_out_of_bounds_is_named(bound: Bound, value: object, reason: str) -> None:
    with pytest.raises(WireError, match=f"^here[.: ]*{re.escape(reason)}$"):
        bound.check("here", value)


@pytest.mark.parametrize(
    ("bound", "value"),
    [
        (Between(5, 9), 5),
        (Between(5, 9), 9),
        (Between(0), 2**53),
        (Flag(), False),
        (Text(3), "abc"),
        (Text(choices=("a",)), "a"),
        (Numbers(), {"x/y": 1.0, "z": -MAX_NUMBER, "z_2.": MAX_NUMBER}),
        (Numbers(), {f"n{n}": 1.0 for n in range(64)}),
        (Texts(2), {"tokens": "ab"}),
    ],
)
def test_what_is_within_bounds_passes(bound: Bound, value: object) -> None:
    assert bound.check("here", value) == value
    assert bound.fit(value) == value


words = st.text(max_size=70) | st.sampled_from(["a", "b/c", "d.e_f"])
wild = st.floats() | st.integers() | st.sampled_from([NAN, INF, -INF, 10**400])


@given(st.dictionaries(words, wild, max_size=70))
def test_lenient_numbers_never_fail_and_keep_what_fits(values: dict[str, Any]) -> None:
    bound = Numbers(lenient=True)
    fitted = bound.fit(values)
    assert bound.check("here", fitted) == fitted
    small = {k: v for k, v in values.items() if k in ("a", "b/c") and abs(v) <= MAX_NUMBER}
    good = {k: float(v) for k, v in small.items()}  # integers above 2^53 are rounded
    assert {k: fitted[k] for k in good} == good or len(fitted) == MAX_ENTRIES
    beyond = bound.fit({"a": INF, "b": -2e18, "c": NAN, "D": 1.0, "e": 10**400})
    assert beyond == {"a": MAX_NUMBER, "b": -MAX_NUMBER, "e": MAX_NUMBER}


@given(st.dictionaries(words, st.text(max_size=40).map(lambda t: t * 40), max_size=70))
def test_lenient_texts_never_fail_and_have_room(values: dict[str, str]) -> None:
    bound = Texts(MAX_TEXT, lenient=True)
    fitted = bound.fit(values)
    assert bound.check("here", fitted) == {name: plain(text) for name, text in fitted.items()}
    assert sum(len(text.encode()) for text in fitted.values()) <= MAX_TEXTS


@pytest.mark.parametrize("text", ["x" * 5000, "\u20ac" * 5000, "\ud800" * 5000])
def test_texts_that_may_be_cut_are_cut_to_bytes_of_utf_8(text: str) -> None:
    assert 0 < len(Text(cut=True).fit(text).encode()) <= MAX_TEXT
    assert Text().fit(text) == text


# Headers


@dataclass(frozen=True)
class Probe(Message):
    """A message with one field."""

    kind: ClassVar[str] = "probe"
    a: Annotated[int, Between(0, 9)]


def packed(**fields: Any) -> bytes:
    """A header with a checksum that holds."""
    values = {"v": PROTOCOL, "kind": "probe", **fields, "crc": 2**32 - 1}
    return with_checksum([msgpack.packb({n: v for n, v in values.items() if v is not None})])[0]


def bare(**fields: Any) -> bytes:
    """A header without a checksum."""
    made: bytes = msgpack.packb({"v": PROTOCOL, "kind": "probe", **fields})
    return made


def nested(depth: int) -> bytes:
    """A map in a map in a map, of valid msgpack."""
    return b"\x82\xa1v" + bytes([PROTOCOL]) + b"\xa1a" + b"\x81\xa1a" * depth + b"\x01"


def test_a_message_is_read_as_it_was_sealed() -> None:
    frames = Probe(3).encode()
    assert read(Probe, opened(frames)) == Probe(3)
    assert frames == [packed(a=3)]
    with pytest.raises(WireError, match="probe: a must be an integer between 0 and 9, got 10"):
        Probe(10).encode()


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (b"", f"{UNPACKED}Unpack failed: incomplete input"),
        (b"\xc1", f"{UNPACKED}a byte begins no value"),
        (b"\x01\x01", f"{UNPACKED}unpack(b) received extra data."),
        (b"\x01", "the header must be a map, got 1"),
        (b"\x90", "the header must be a map, got a list"),
        (bare()[:-1], f"{UNPACKED}Unpack failed: incomplete input"),
        (bare() + b"\x00", f"{UNPACKED}unpack(b) received ext"),
        (b"\xdf\xff\xff\xff\xff", f"{UNPACKED}4294967295 exceeds"),
        (b"\xdd\xff\xff\xff\xff", f"{UNPACKED}4294967295 exceeds"),
        (b"\x81\x01\x01", f"{UNPACKED}int is not allowed for ma"),
        (nested(2000), f"{UNPACKED}it is nested too deeply"),
        (packed(a=[1]), f"{UNPACKED}1 exceeds max_array_len(0)"),
        (packed(a=b"1"), f"{UNPACKED}1 exceeds max_bin_len(0)"),
        (packed(a=msgpack.ExtType(5, b"x")), f"{UNPACKED}2 exceeds max_ext_len(0)"),
        (packed(a="x" * (MAX_TEXT + 1)), f"{UNPACKED}1025 exceeds max_str_len(1024)"),
        (packed(a={str(n): n for n in range(65)}), f"{UNPACKED}65 exceeds max_map_len(64)"),
        (with_checksum([bare(a="x", crc=2**17).replace(b"\xa1x", b"\xa1\xff")])[0], UNPACKED),
        (bytes(MAX_HEADER + 1), f"the header has {MAX_HEADER + 1} bytes, at most {MAX_HEADER}"),
        (packed(v=None), "header: the field v is missing"),
        (packed(kind=None), "header: the field kind is missing"),
        (packed(v="1"), f"header: v must be an integer between 0 and {2**53}, got '1'"),
        (packed(kind=3), "header: kind must be a text of at most 32 characters, got 3"),
        (packed(kind="x" * 33), "header: kind must be a text of at most 32 characters, got 'xxx"),
        (packed(kind="other", a=1), "expected probe, got a message of kind 'other'"),
        (packed(), "probe: the field a is missing"),
        (packed(a={"b": {"c": 1}}), "probe: a must be an integer between 0 and 9, got a dict"),
        (packed(a=1, more=2), "probe: unknown field 'more'"),
    ],
)
def test_what_is_no_message_is_refused(frame: bytes, reason: str) -> None:
    with pytest.raises(WireError) as caught:
        read(Probe, opened([frame]))
    assert str(caught.value).startswith(reason)
    assert not isinstance(caught.value, ProtocolError | DamagedError)


def test_what_comes_with_too_many_frames_or_none_is_refused() -> None:
    frames = seal("probe", {"a": 3}, [b"array"])
    with pytest.raises(WireError, match="probe: there must be 1 frame, got 2"):
        read(Probe, opened(frames), frames[1:])
    with pytest.raises(WireError, match="the message is empty"):
        opened([])


@pytest.mark.parametrize("frame", [packed(v=PROTOCOL + 1), bare(v=2), bare(v=0, crc="none")])
def test_another_version_says_what_to_install(frame: bytes) -> None:
    """A later one that has kept the checksum, and earlier ones that had none."""
    message = (
        f"the other side speaks protocol {msgpack.unpackb(frame)['v']}, this one {PROTOCOL}: "
        "install the same version of tangram on both"
    )
    with pytest.raises(ProtocolError, match=f"^{message}$"):
        opened([frame])


def test_a_header_too_large_to_be_received_is_not_packed() -> None:
    with pytest.raises(WireError, match=f"big: the header has .* bytes, at most {MAX_HEADER}"):
        seal("big", {str(number): "x" * MAX_TEXT for number in range(16)}, [])


# Checksums

SEALED = seal("probe", {"a": 3, "b": "text"}, [b"first array", b"", b"second array"])


@pytest.mark.parametrize("number", range(len(SEALED)))
def test_no_bit_of_a_message_may_change(number: int) -> None:
    frame = SEALED[number]
    for bit in range(8 * len(frame)):
        changed = bytearray(frame)
        changed[bit // 8] ^= 1 << bit % 8
        with pytest.raises(WireError) as caught:
            opened([*SEALED[:number], bytes(changed), *SEALED[number + 1 :]])
        # What tells one message from another, and a peer of another version, is believed by none.
        assert not isinstance(caught.value, ProtocolError)
        mark = number == 0 and -9 <= bit // 8 - len(frame) < -4
        assert mark or isinstance(caught.value, DamagedError)


ONE, TWO, THREE, FOUR = SEALED


@pytest.mark.parametrize(
    "frames",
    [
        [ONE, TWO, THREE],
        [ONE, THREE, FOUR],
        [ONE, FOUR, THREE, TWO],
        [ONE, TWO, THREE, FOUR, b"more"],
        [ONE, *Probe(3).encode()],
        [bare(a=3)],
    ],
)
def test_no_frame_may_go_or_come_or_change_its_place(frames: list[bytes]) -> None:
    with pytest.raises(DamagedError, match="the message is damaged: "):
        opened(frames)


@given(st.binary(max_size=200))
def test_random_bytes_raise_nothing_but_wire_errors(frame: bytes) -> None:
    with pytest.raises(WireError):
        opened([frame])
