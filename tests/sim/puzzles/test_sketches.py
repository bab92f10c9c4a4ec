"""Puzzle files that are none, and files of which only a part is any good."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_core.errors import ConfigError
from tangram_sim.puzzles.figures import parse_puzzles, read_puzzles
from tangram_sim.puzzles.sketches import MAX_BYTES, MAX_PUZZLES
from tests.sim.puzzles.drawings import figure, file_of

pytestmark = pytest.mark.fast

KINDS = "large_triangle, medium_triangle, small_triangle, square, parallelogram"


def message_of(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_puzzles(text, "my.json")
    assert "\n" not in str(caught.value)
    return str(caught.value)


# The file


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "my.json is not JSON that can be read: check line 1"),
        ('{\n"format": }', "my.json is not JSON that can be read: check line 2 and the one before"),
        ("[" * 100_000, "my.json is not JSON that can be read: check its nesting and numbers"),
        ("9" * 5000, "my.json is not JSON that can be read: check its nesting and numbers"),
        ("[]", "my.json must be a mapping with exactly the keys format, version, puzzles, got []"),
        ('{"a": 1, "a": 2}', "my.json: a key is given twice among ['a', 'a']: remove one"),
    ],
)
def test_what_is_no_mapping_is_refused(text: str, message: str) -> None:
    assert message_of(text) == message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extra": 1}, "must be a mapping with exactly the keys format, version, puzzles, got {"),
        ({"format": "chess"}, "my.json: format must be 'tangram-puzzles', got 'chess'"),
        (
            {"version": 2},
            "must be 1, got 2: write the file anew, or read it with the release that ",
        ),
        ({"version": 1.0}, "my.json: version must be 1, got 1.0"),
        ({"puzzles": []}, "my.json: puzzles must be a list of 1 to 1000, got 0"),
        ({"puzzles": {}}, "my.json: puzzles must be a list of 1 to 1000, got {}"),
        ({"puzzles": [1] * (MAX_PUZZLES + 1)}, "puzzles must be a list of 1 to 1000, got 1001"),
    ],
)
def test_a_wrong_head_is_refused(change: dict[str, Any], message: str) -> None:
    assert message in message_of(json.dumps(file_of(figure("cat")) | change))


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "my.json"
    for content, reason in (
        (b" " * (MAX_BYTES + 1), f"larger than {MAX_BYTES} bytes: split it"),
        (b"\xff\xfe{\x00}\x00", "is not UTF-8: save it as UTF-8"),
    ):
        file.write_bytes(content)
        with pytest.raises(ConfigError, match=reason):
            read_puzzles(file)
    assert "longer than" in message_of(" " * (MAX_BYTES + 1))
    for path in (tmp_path, tmp_path / "missing.json", Path("/dev/zero")):
        with pytest.raises(ConfigError, match="is no file: check the path"):
            read_puzzles(path)
    with pytest.raises(ConfigError, match=r"is no file \(File name too long\): check the path"):
        read_puzzles(tmp_path / ("a" * 300))


def test_a_file_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "cat.json"
    path.write_text(json.dumps(file_of(figure("cat"))), encoding="utf-8-sig")
    assert [puzzle.name for puzzle in read_puzzles(path)] == ["cat"]


# One puzzle


CORNER = "piece 3 (small_triangle): a corner must be [x, y], finite and within +-1e+06"
NO_CORNERS: list[Any] = [7, [1], [1, 2, 3], ["1", 2], [None, 2], [True, 2], [float("nan"), 0]]
NO_CORNERS += [[0, float("inf")], [0, -2e6], [10**30, 0]]


def at(path: str, value: Any) -> Callable[[Any], None]:
    """A change of an entry: "pieces.2.corners" etc. is set to the value."""

    def change(entry: Any) -> None:
        *way, last = (int(key) if key.isdigit() else key for key in path.split("."))
        for key in way:
            entry = entry[key]
        entry[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (at("title", "x"), "puzzle number 2 must have exactly the keys name, pieces, got {'name'"),
        (at("name", ""), "puzzle number 2: name must be 1 to 64 printable characters, got ''"),
        (at("name", "a\nb"), r"name must be 1 to 64 printable characters, got 'a\nb'"),
        (
            at("name", "duck"),
            "puzzle number 2: the name 'duck' belongs to an earlier puzzle: rename one",
        ),
        (at("pieces", []), "puzzle 'cat': pieces must be a list of 1 to 16, got 0"),
        (at("pieces", [0] * 17), "puzzle 'cat': pieces must be a list of 1 to 16, got 17"),
        (at("pieces.0", 3), "puzzle 'cat', piece 1 must have exactly the keys shape, corners, go"),
        (at("pieces.0.angle", 3), "puzzle 'cat', piece 1 must have exactly the keys shape, corne"),
        (at("pieces.2.shape", "disc"), f"piece 3: shape must be one of {KINDS}, got 'disc'"),
        (
            at("pieces.2.corners", None),
            "(small_triangle): corners must be a list of 3 pairs, got N",
        ),
        (at("pieces.0.corners", [[0, 0]] * 3), "corners must be a list of 4 pairs, got 3"),
        (at("pieces.0.corners", [[0, 0]] * 4), "it is 0 times as large as it should be; draw the"),
        *((at("pieces.2.corners.1", value), f"{CORNER}, got {value!r}") for value in NO_CORNERS),
    ],
)
def test_a_fault_is_named(change: Callable[[Any], None], message: str) -> None:
    cat = figure("cat")
    change(cat)
    text = json.dumps(file_of(figure("duck"), cat, figure("swan")))
    assert message in message_of(text)


def test_all_faults_of_a_file_are_told_at_once() -> None:
    cat, duck = figure("cat"), figure("duck")
    cat["pieces"][1]["shape"] = cat["pieces"][4]["shape"] = "disc"
    duck["pieces"].pop()
    text = json.dumps(file_of(cat, duck, figure("swan"), 5))
    assert [fault[:22] for fault in message_of(text).split("; ")] == [
        "puzzle 'cat', piece 2:",
        "puzzle 'cat', piece 5:",
        "puzzle 'duck': has 1 s",
        "puzzle number 4 must h",
    ]


def test_a_message_is_bounded() -> None:
    told = message_of(json.dumps(file_of(*["x" * 1000] * 500)))
    assert told.endswith("; and 480 more")
    assert len(told) < 5000


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)
PLACES = st.sampled_from(
    ["name", "pieces", "pieces.0", "pieces.3.shape", "pieces.3.corners", "pieces.3.corners.0"]
)


@settings(max_examples=100)
@given(PLACES, VALUES)
def test_whatever_stands_in_a_file_is_a_puzzle_or_a_fault(place: str, value: Any) -> None:
    cat = figure("cat")
    at(place, value)(cat)
    try:
        assert parse_puzzles(json.dumps(file_of(cat)), "my.json")
    except ConfigError as error:
        assert "\n" not in str(error)  # noqa: PT017
