"""Headers: what is not a small flat map of known fields is refused before anyone looks at it."""

from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tangram_agent.frames import (
    MAX_ENTRIES,
    MAX_HEADER,
    MAX_INTEGER,
    MAX_TEXT,
    PROTOCOL,
    Fields,
    ProtocolError,
    checked_numbers,
    pack_header,
    unpack_header,
    unpack_map,
)
from tangram_sim.errors import WireError

pytestmark = pytest.mark.fast

NAN = float("nan")
NUMBERS_RULE = "a name is 1 to 64 characters of a-z, 0-9, _, . and /, got"


def header(**fields: Any) -> bytes:
    packed: bytes = msgpack.packb({"v": PROTOCOL, "kind": "test", **fields})
    return packed


def nested(depth: int) -> bytes:
    """A map in a map in a map, of valid msgpack."""
    return (
        b"\x83\xa1v" + bytes([PROTOCOL]) + b"\xa4kind\xa4test\xa1a" + b"\x81\xa1a" * depth + b"\x01"
    )


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (b"", "the header is not msgpack within the limits: Unpack failed: incomplete input"),
        (b"\xc1", "the header is not msgpack within the limits: "),
        (
            b"\x01\x01",
            "the header is not msgpack within the limits: unpack(b) received extra data.",
        ),
        (b"\x01", "the header must be a map, got 1"),
        (b"\x90", "the header must be a map, got a list"),
        (header()[:-1], "the header is not msgpack within the limits: Unpack failed: incomplete "),
        (header() + b"\x00", "the header is not msgpack within the limits: unpack(b) received ext"),
        (
            b"\xdf\xff\xff\xff\xff",
            "the header is not msgpack within the limits: 4294967295 exceeds",
        ),
        (
            b"\xdd\xff\xff\xff\xff",
            "the header is not msgpack within the limits: 4294967295 exceeds",
        ),
        (b"\x81\x01\x01", "the header is not msgpack within the limits: int is not allowed for ma"),
        (header(a=[1]), "the header is not msgpack within the limits: 1 exceeds max_array_len(0)"),
        (header(a=b"1"), "the header is not msgpack within the limits: 1 exceeds max_bin_len(0)"),
        (
            header(a=msgpack.ExtType(5, b"x")),
            "the header is not msgpack within the limits: 2 exceeds max_ext_len(0)",
        ),
        (
            header(a="x" * (MAX_TEXT + 1)),
            "the header is not msgpack within the limits: 1025 exceeds max_str_len(1024)",
        ),
        (
            header(a={str(n): n for n in range(MAX_ENTRIES + 1)}),
            "the header is not msgpack within the limits: 65 exceeds max_map_len(64)",
        ),
        (header(a="x").replace(b"\xa1x", b"\xa1\xff"), "the header is not msgpack within the lim"),
        (bytes(MAX_HEADER + 1), f"the header has {MAX_HEADER + 1} bytes, at most {MAX_HEADER}"),
        (nested(2000), "the header is not msgpack within the limits: "),
        (msgpack.packb({"kind": "test"}), "header: the field v is missing"),
        (msgpack.packb({"v": PROTOCOL}), "header: the field kind is missing"),
        (header(v="1"), f"header: v must be an integer between 0 and {MAX_INTEGER}, got '1'"),
        (header(kind=3), "header: kind must be a text of at most 32 characters, got 3"),
        (header(kind="x" * 33), "header: kind must be a text of at most 32 characters, got 'xxx"),
    ],
)
def test_what_is_no_header_is_refused(frame: bytes, reason: str) -> None:
    with pytest.raises(WireError) as caught:
        unpack_header(frame)
    assert str(caught.value).startswith(reason)


def test_a_header_of_exactly_the_limit_is_read() -> None:
    fields = {f"f{number}": "x" * 1000 for number in range(16)}
    frame = header(**fields)
    assert unpack_map(frame, len(frame), max_bin=0).kind == "test"
    with pytest.raises(WireError, match="bytes, at most"):
        unpack_map(frame, len(frame) - 1, max_bin=0)


def test_depth_is_refused_where_a_scalar_is_expected() -> None:
    """Deep maps within the size limit unpack, but no field takes them."""
    fields = unpack_header(nested(500))
    with pytest.raises(WireError, match=r"test: a must be an integer .*, got a dict"):
        fields.integer("a", 0)
    with pytest.raises(WireError, match=r"test: a.a must be a finite number, got a dict"):
        unpack_header(nested(500)).numbers("a")


def test_another_version_says_what_to_install() -> None:
    with pytest.raises(ProtocolError) as caught:
        unpack_header(header(v=PROTOCOL + 1))
    assert str(caught.value) == (
        f"the other side speaks protocol {PROTOCOL + 1}, this one {PROTOCOL}: "
        "install the same version of tangram on both"
    )


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (4, "test: a must be an integer between 5 and 9, got 4"),
        (10, "test: a must be an integer between 5 and 9, got 10"),
        (7.0, "test: a must be an integer between 5 and 9, got 7.0"),
        (True, "test: a must be an integer between 5 and 9, got True"),
        (None, "test: a must be an integer between 5 and 9, got None"),
        ("7", "test: a must be an integer between 5 and 9, got '7'"),
        ("\x1b[31m", r"test: a must be an integer between 5 and 9, got '\x1b[31m'"),
        ("x" * 50, f"test: a must be an integer between 5 and 9, got '{'x' * 40}...'"),
        ({}, "test: a must be an integer between 5 and 9, got a dict"),
    ],
)
def test_integers(value: object, reason: str) -> None:
    with pytest.raises(WireError) as caught:
        unpack_header(header(a=value)).integer("a", 5, 9)
    assert str(caught.value) == reason


def test_a_boolean_is_no_integer() -> None:
    with pytest.raises(WireError, match="test: a must be an integer between 0 and 9, got True"):
        unpack_header(header(a=True)).integer("a", 0, 9)


@pytest.mark.parametrize("value", [5, 9])
def test_integers_at_their_bounds(value: int) -> None:
    assert unpack_header(header(a=value)).integer("a", 5, 9) == value


def test_booleans_and_texts() -> None:
    fields = unpack_header(header(yes=True, name="abc", role="player"))
    assert fields.boolean("yes") is True
    assert fields.text("name", 3) == "abc"
    assert fields.text("role", choices=("player", "evaluator")) == "player"
    fields.end()
    with pytest.raises(WireError, match="test: yes must be true or false, got 1"):
        unpack_header(header(yes=1)).boolean("yes")
    with pytest.raises(WireError, match="test: name must be a text of at most 2 characters, got"):
        unpack_header(header(name="abc")).text("name", 2)
    with pytest.raises(WireError, match=r"test: name must be a text of at most 1024 .*, got 5"):
        unpack_header(header(name=5)).text("name")
    with pytest.raises(WireError, match="test: role must be one of player, evaluator, got 'spy'"):
        unpack_header(header(role="spy")).text("role", choices=("player", "evaluator"))


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (3, "test: a must be a map, got 3"),
        ({"x": NAN}, "test: a.x must be a finite number, got nan"),
        ({"x": float("-inf")}, "test: a.x must be a finite number, got -inf"),
        ({"x": 2e18}, "test: a.x must be a finite number, got 2e+18"),
        ({"x": True}, "test: a.x must be a finite number, got True"),
        ({"x": "1"}, "test: a.x must be a finite number, got '1'"),
        ({"X": 1}, f"test: a: {NUMBERS_RULE} 'X'"),
        ({"": 1}, f"test: a: {NUMBERS_RULE} ''"),
        ({"x" * 65: 1}, f"test: a: {NUMBERS_RULE} '{'x' * 40}...'"),
        ({"x\n": 1}, rf"test: a: {NUMBERS_RULE} 'x\n'"),
    ],
)
def test_numbers(values: object, reason: str) -> None:
    with pytest.raises(WireError) as caught:
        unpack_header(header(a=values)).numbers("a")
    assert str(caught.value) == reason


def test_numbers_and_texts_are_read() -> None:
    fields = unpack_header(header(a={"x/y": 1, "z": 0.5}, b={"tokens": "ab"}))
    assert fields.numbers("a") == {"x/y": 1.0, "z": 0.5}
    assert fields.texts("b", 2) == {"tokens": "ab"}
    with pytest.raises(WireError, match=r"test: b.tokens must be a text of at most 1 character"):
        unpack_header(header(b={"tokens": "ab"})).texts("b", 1)
    with pytest.raises(WireError, match=r"test: b.tokens must be a text of at most 9 .*, got 3"):
        unpack_header(header(b={"tokens": 3})).texts("b", 9)


def test_a_field_is_taken_once_and_none_is_left() -> None:
    fields = unpack_header(header(a=1, b=2))
    assert fields.integer("a", 0) == 1
    with pytest.raises(WireError, match="test: the field a is missing"):
        fields.integer("a", 0)
    with pytest.raises(WireError, match="test: unknown field 'b'"):
        fields.end()


def test_data_is_bytes() -> None:
    frame = header(data=b"123")
    assert unpack_map(frame, 100, max_bin=3).data("data") == b"123"
    with pytest.raises(WireError, match=r"3 exceeds max_bin_len\(2\)"):
        unpack_map(frame, 100, max_bin=2)
    with pytest.raises(WireError, match="test: data must be bytes, got 'text'"):
        unpack_header(header(data="text")).data("data")


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"a": NAN}, "here: a must be a finite number, got nan"),
        ({"A": 1.0}, f"here: {NUMBERS_RULE} 'A'"),
        ({f"n{n}": 1.0 for n in range(65)}, "here: at most 64 numbers, got 65"),
    ],
)
def test_numbers_are_checked_before_they_are_sent(values: dict[str, float], reason: str) -> None:
    with pytest.raises(WireError) as caught:
        checked_numbers("here", values)
    assert str(caught.value) == reason


def test_a_header_too_large_to_be_received_is_not_packed() -> None:
    with pytest.raises(WireError, match=f"big: the header has .* bytes, at most {MAX_HEADER}"):
        pack_header("big", {"a": "x" * MAX_HEADER})


@given(st.binary(max_size=200))
def test_random_bytes_raise_nothing_but_wire_errors(frame: bytes) -> None:
    try:
        fields = unpack_header(frame)
    except WireError:
        return
    assert isinstance(fields, Fields)
