"""The journal: what was appended comes back, in order, however the master ended."""

import errno
import os
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from master.record import journal as journal_module
from master.record import recovery as recovery_module
from master.record.delivery import EpisodesArrived
from master.record.journal import FORMAT, HEAD, MAGIC, MARK, JournalError, Place, Title, segments
from master.record.recovery import Reader, journal_run_id
from tangram_core.errors import RunError
from tangram_core.setup import Setup
from tangram_core.wire.arrays import join_frames, most_episodes
from tangram_core.wire.schema import opened, seal
from tests.agent.builders import PAIR, setup, watched_disk
from tests.master.builders import Disk, arrival, close_journals, journal, small_setup

pytestmark = pytest.mark.fast

MADE = small_setup()


def read(
    folder: Path,
    warnings: list[str] | None = None,
    after: Place | None = None,
    run_id: str = "run",
    made: Setup = MADE,
) -> list[EpisodesArrived]:
    warn = pytest.fail if warnings is None else warnings.append
    return list(Reader(folder, after, run_id, made.task_digest(), made.spec, warn))


def read_all(folder: Path, warnings: list[str]) -> Reader:
    """A reader at its end."""
    reader = Reader(folder, None, "run", MADE.task_digest(), MADE.spec, warnings.append)
    list(reader)
    return reader


def sequences(folder: Path, **more: Any) -> list[int]:
    return [found.sequence for found in read(folder, **more)]


def assert_same(one: EpisodesArrived, other: EpisodesArrived) -> None:
    for name in ("role", "index", "incarnation", "process", "owner", "sequence", "weights_version"):
        assert getattr(one, name) == getattr(other, name), name
    for name, ours in one.episodes.arrays.items():
        theirs = other.episodes[name]
        assert ours.dtype == theirs.dtype, name
        np.testing.assert_array_equal(ours, theirs, err_msg=name)


@pytest.mark.parametrize("made", [MADE, setup(PAIR)], ids=["square", "pair"])
def test_batches_come_back_as_they_were_appended(tmp_path: Path, made: Setup) -> None:
    written = [arrival(made, number, count=number, version=number - 2) for number in (1, 2, 3)]
    kept = journal(tmp_path, made)
    written[1] = replace(written[1], process="hers", owner="alice")
    for one in written:
        kept.append(one)  # not closed: as a kill leaves it
    for one, other in zip(written, read(tmp_path, made=made), strict=True):
        assert_same(one, other)
    assert journal_run_id(tmp_path) == "run"


def test_nothing_is_written_before_the_first_batch(tmp_path: Path) -> None:
    journal(tmp_path / "journal", MADE).close()
    assert not (tmp_path / "journal").exists()
    assert read(tmp_path / "journal") == []
    assert journal_run_id(tmp_path / "journal") is None


@pytest.mark.parametrize(("sync_s", "syncs"), [(0.0, 3), (1000.0, 0)])
def test_batches_are_with_the_operating_system_at_once_and_synced_on_their_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sync_s: float, syncs: int
) -> None:
    """First the folder, or the file of a new segment would have no name after a power cut."""
    done, sizes = watched_disk(monkeypatch), [0]
    kept = journal(tmp_path, MADE, sync_s)
    for number in (1, 2, 3):
        kept.append(arrival(MADE, number))
        sizes.append(segments(tmp_path)[1].stat().st_size)
    assert sizes == sorted(set(sizes))
    paths = (tmp_path.parent, tmp_path, *tmp_path.iterdir())
    above, folder, file = (path.stat().st_ino for path in paths)
    assert done == [above, folder, file, *[file] * syncs]  # a title at once
    kept.close()
    assert done == [above, folder, file, *[file] * max(syncs, 1)]


def test_every_checkpoint_begins_a_segment_every_life_goes_on_and_covered_ones_are_dropped(
    tmp_path: Path,
) -> None:
    journal(tmp_path, MADE).append(arrival(MADE, 1))
    kept = journal(tmp_path, MADE, number=1)
    kept.append(arrival(MADE, 2))
    assert [kept.rotate() for _ in range(2)] == 2 * [Place(2, 2)]  # nothing came in between
    assert list(segments(tmp_path)) == [1, 2]  # there before the checkpoint that names it
    kept.append(arrival(MADE, 3))
    assert [sequences(tmp_path, after=Place(*n)) for n in ((1, 0), (2, 2))] == [[1, 2, 3], [3]]
    kept.drop_before(2)
    assert list(segments(tmp_path)) == [2]
    kept.drop_before(99)  # never the current one
    assert list(segments(tmp_path)) == [2]
    kept.append(arrival(MADE, 4))
    assert sequences(tmp_path, after=Place(2, 2)) == [3, 4]


@given(st.data())
def test_wherever_a_kill_cuts_whole_batches_come_back(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("journal")
    kept = journal(folder, MADE)
    ends = []
    for number in (1, 2, 3):
        kept.append(arrival(MADE, number, count=1))
        ends.append(segments(folder)[1].stat().st_size)
    close_journals()
    cut = data.draw(st.integers(0, ends[-1]))
    os.truncate(segments(folder)[1], cut)
    warnings: list[str] = []
    whole = [number for number, end in zip((1, 2, 3), ends, strict=True) if end <= cut]
    assert sequences(folder, warnings=warnings) == whole
    title = ends[0] - (ends[1] - ends[0])
    torn = cut not in (0, title, *ends)
    assert len(warnings) == torn
    assert all("cut short" in line and "it was not acknowledged" in line for line in warnings)


def test_a_life_that_goes_on_behind_a_torn_record_loses_nothing(tmp_path: Path) -> None:
    """Wherever the kill came. The next life cuts it off, so that nothing else hides inside."""
    written = journal(tmp_path, MADE)
    for number in (1, 2):
        written.append(arrival(MADE, number, count=1))
    path = segments(tmp_path)[1]
    whole = path.read_bytes()
    second = len(record_at(whole, 2))
    for left in (1, HEAD.size - 1, HEAD.size, HEAD.size + 9, second - 1):
        path.write_bytes(whole[: len(whole) - second + left])
        warnings: list[str] = []
        reader = read_all(tmp_path, warnings)
        [line] = warnings
        assert "is cut short" in line
        assert "not acknowledged" in line
        assert (reader.number, reader.torn) == (1, len(whole) - second)
        kept = journal(tmp_path, MADE, number=reader.number, torn=reader.torn)
        kept.append(arrival(MADE, 3, count=1))
        assert path.read_bytes().startswith(whole[:-second] + MAGIC)
        assert read_all(tmp_path, warnings).torn is None
        assert sequences(tmp_path, warnings=warnings) == [1, 3]
        assert len(warnings) == 1


def test_what_is_cut_off_is_of_the_newest_segment(tmp_path: Path) -> None:
    """Which is empty here: it must not become as long as the torn one."""
    journal(tmp_path, MADE).append(arrival(MADE, 1))
    with segments(tmp_path)[1].open("ab") as file:
        file.write(b"torn")
    (tmp_path / "00000002.log").touch()
    assert read_all(tmp_path, []).torn is None


def test_a_record_that_a_player_hid_in_a_batch_is_never_read(tmp_path: Path) -> None:
    """If a kill tears the batch, or the disk changes a bit; a title ended the run for ever."""
    [title] = Title(FORMAT, "other", "other").encode()
    journal(tmp_path, MADE).append(arrival(MADE, 1))
    path = segments(tmp_path)[1]
    whole, hidden = path.read_bytes(), record(title, mark=b"")
    batch = record_at(whole, 1)
    for harmed, found in (
        (head(1000 + len(hidden), 2, 1) + hidden, [1]),
        (head(1000 + len(hidden), 2, 1) + hidden + bytes(1000) + batch, [1, 1]),
        (b"damaged by the disk, in a head" + hidden + batch, [1, 1]),
        (b"damaged by the disk, in a head" + head(10**6, 2, 1) + batch, [1, 1]),
    ):
        path.write_bytes(whole + harmed)
        warnings: list[str] = []
        assert sequences(tmp_path, warnings=warnings) == found
        assert len(warnings) == 1


def record_at(content: bytes, number: int) -> bytes:
    """The record of a batch, of those whose heads are whole."""
    at = -1
    while (at := content.find(MAGIC, at + 1)) >= 0:
        _, length, found, *_ = HEAD.unpack_from(content, at)
        record = content[at : at + HEAD.size + length]
        if found == number and b"episodes" in record:
            return record
    raise AssertionError(f"there is no record {number}")


def damaged(folder: Path, number: int, byte: int) -> int:
    """Three batches in each of two segments, one bit of a record changed; its first byte."""
    kept = journal(folder, MADE)
    for sequence in range(1, 7):
        kept.append(arrival(MADE, sequence))
        if sequence == 3:
            kept.rotate()
    path = segments(folder)[1 if number <= 3 else 2]
    content = path.read_bytes()
    start = content.index(record_at(content, number))
    flipped = bytes([content[start + byte] ^ 1])
    path.write_bytes(content[: start + byte] + flipped + content[start + byte + 1 :])
    return start


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("byte", [0, 4, 7, 8, 16, 20, HEAD.size, HEAD.size + 40])
def test_damage_anywhere_in_a_record_costs_that_record_and_is_told_with_its_number(
    tmp_path: Path, number: int, byte: int
) -> None:
    """A flipped bit of a length made all that followed look like a torn record."""
    start = damaged(tmp_path, number, byte)
    warnings: list[str] = []
    assert sequences(tmp_path, warnings=warnings) == [n for n in range(1, 7) if n != number]
    path = segments(tmp_path)[1 if number <= 3 else 2]
    assert warnings == [f"{path} is damaged at byte {start:,}: 1 batch is lost"]


@pytest.mark.parametrize(
    ("byte", "told"),
    [
        (HEAD.size + 40, "1 batch is lost"),
        (5, "the batches in that part are lost, and their number is unknown"),
    ],
)
def test_damage_at_the_end_is_no_torn_record_in_any_later_life(
    tmp_path: Path, byte: int, told: str
) -> None:
    start = damaged(tmp_path, 6, byte)
    path = segments(tmp_path)[2]
    for life in range(3):
        warnings: list[str] = []
        reader = read_all(tmp_path, warnings)
        assert warnings == [f"{path} is damaged at byte {start:,}: {told}"]
        kept = journal(tmp_path, MADE, number=reader.number, torn=reader.torn)
        kept.append(arrival(MADE, 7 + life))
    assert sequences(tmp_path, warnings=warnings) == [1, 2, 3, 4, 5, 7, 8, 9]


def test_the_next_record_is_found_wherever_a_chunk_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged(tmp_path, 1, 0)
    for chunk in range(HEAD.size + 1, HEAD.size + 80):
        monkeypatch.setattr(recovery_module, "CHUNK", chunk)
        assert sequences(tmp_path, warnings=[]) == [2, 3, 4, 5, 6]


@pytest.mark.parametrize("number", [2, 3, 5, 6])
def test_bytes_that_vanished_from_a_record_cost_that_record(tmp_path: Path, number: int) -> None:
    start = damaged(tmp_path, number, 0) + HEAD.size + 50
    path = segments(tmp_path)[1 if number <= 3 else 2]
    content = path.read_bytes()
    content = content[: start - HEAD.size - 50] + MAGIC + content[start - HEAD.size - 46 :]
    path.write_bytes(content[:start] + content[start + 7 :])
    warnings: list[str] = []
    assert sequences(tmp_path, warnings=warnings) == [n for n in range(1, 7) if n != number]
    assert len(warnings) == 1


def starts(content: bytes) -> list[int]:
    """Where the title and each batch of a segment begin, and its end, as it was written."""
    at = [0]
    while at[-1] < len(content):
        at.append(at[-1] + HEAD.size + HEAD.unpack_from(content, at[-1])[1])
    return at


@pytest.mark.parametrize("later", [False, True], ids=["at the end", "before another life"])
@pytest.mark.parametrize(
    ("hits", "told"),
    [
        ("body 6", "1 batch is lost"),
        ("body 5, body 6", "2 batches are lost"),
        ("head 4, head 5, body 6", "3 batches are lost"),
        ("body 4, body 5, head 6", "at least 2 batches are lost"),
        ("body 4, head 5, head 6", "at least 1 batch is lost"),
        ("body 4, zeros 5", "at least 2 batches are lost"),
        ("zeros 4", "at least 1 batch is lost"),
        ("body 5, cut 6", "at least 1 batch is lost"),
        ("head 4, cut 5", "the batches in that part are lost, and their number is unknown"),
        ("head 4, head 5, head 6", "the batches in that part are lost, and their number is"),
    ],
)
def test_of_a_damaged_end_no_more_is_claimed_than_is_known(
    tmp_path: Path, hits: str, told: str, later: bool
) -> None:
    """Who is told too low a number believes that the rest is there."""
    kept = journal(tmp_path, MADE)
    for number in range(1, 7):
        kept.append(arrival(MADE, number))
    close_journals()
    content = bytearray(segments(tmp_path)[1].read_bytes())
    at, whole = starts(content), [1, 2, 3, 4, 5, 6]
    for hit in hits.split(", "):
        kind, number = hit[:-2], int(hit[-1])
        body = at[number] + HEAD.size + 9
        if kind == "cut":
            del content[body:]
        elif kind == "zeros":
            content[body:] = bytes(len(content) - body)
        else:
            content[body if kind == "body" else at[number] + 5] ^= 1
        last = 6 if kind in ("cut", "zeros") else number
        whole = [n for n in whole if not number <= n <= last]
    segments(tmp_path)[1].write_bytes(content)
    damaged = at[len(whole) + 1]
    for life in range(1 + later):
        warnings: list[str] = []
        reader = read_all(tmp_path, warnings)
        [line] = warnings
        if life and "cut" in hits:  # the life before told of that part, and cut it off
            told = told.removeprefix("at least ")
        assert line.startswith(f"{segments(tmp_path)[1]} is damaged at byte {damaged:,}: {told}")
        assert sequences(tmp_path, warnings=[]) == whole
        if later and 7 not in whole:
            journal(tmp_path, MADE, number=reader.number, torn=reader.torn).append(arrival(MADE, 7))
            whole.append(7)


def test_a_forged_length_makes_nobody_take_room_for_it(tmp_path: Path) -> None:
    journal(tmp_path, MADE).append(arrival(MADE, 1))
    with segments(tmp_path)[1].open("ab") as file:
        file.write(head(2**32 - 1, 2, 0))
    tracemalloc.start()
    assert sequences(tmp_path, warnings=[]) == [1]
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2**26


@given(st.data())
def test_any_changed_bit_is_told_in_one_line_and_costs_one_batch_at_most(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("journal")
    kept = journal(folder, MADE)
    for number in (1, 2, 3, 4):
        kept.append(arrival(MADE, number, count=1))
        if number != 2:
            kept.rotate()
    path = segments(folder)[2]
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    warnings: list[str] = []
    assert sequences(folder, warnings=warnings) in ([1, 3, 4], [1, 2, 4], [1, 2, 3, 4])
    assert len(warnings) == 1


def test_garbage_in_place_of_a_segment_is_a_loss(tmp_path: Path) -> None:
    """Told with its number where later segments know it; with nothing else the run goes on."""
    kept = journal(tmp_path, MADE)
    for number in (1, 2, 3):
        kept.append(arrival(MADE, number))
        if number != 1:
            kept.rotate()
    found, warnings = segments(tmp_path), list[str]()
    found[1].write_bytes(b"garbage" * 1000)
    assert sequences(tmp_path, warnings=warnings) == [3]
    assert warnings == [f"{found[1]} is damaged at byte 0: 2 batches are lost"]
    for path in segments(tmp_path).values():
        path.write_bytes(b"\0" * 100)
    warnings.clear()
    assert sequences(tmp_path, warnings=warnings) == []
    assert len(warnings) == 1
    assert "damaged at byte 0: the batches in that part are lost, and their n" in warnings[0]
    assert journal_run_id(tmp_path) is None
    journal(tmp_path, MADE).append(arrival(MADE, 4))
    assert sequences(tmp_path, warnings=warnings) == [4]


def test_missing_segments_are_told_in_one_line_and_the_others_are_read(tmp_path: Path) -> None:
    kept = journal(tmp_path, MADE)
    for number in (1, 2, 3, 4):
        kept.append(arrival(MADE, number))
        kept.rotate()
    found, warnings = segments(tmp_path), list[str]()
    found[2].unlink()
    found[3].unlink()
    found[4].rename(tmp_path / "100000000.log")  # more digits than others, and still the last
    found[5].unlink()
    assert sequences(tmp_path, warnings=warnings) == [1, 4]
    assert warnings == [f"{found[2]} and the 99,999,997 after it are missing: 2 batches are lost"]
    (tmp_path / "100000000.log").rename(found[3])
    warnings.clear()
    assert sequences(tmp_path, warnings=warnings, after=Place(2, 1)) == [4]
    assert warnings == [f"{found[2]} is missing: 2 batches are lost"]


def test_a_newest_segment_that_is_missing_is_a_loss_where_a_checkpoint_names_it(
    tmp_path: Path,
) -> None:
    kept = journal(tmp_path, MADE)
    kept.append(arrival(MADE, 1))
    place = kept.rotate()
    warnings: list[str] = []
    assert sequences(tmp_path, after=place) == []
    segments(tmp_path)[2].unlink()
    assert sequences(tmp_path, warnings=warnings, after=place) == []
    assert warnings == [
        f"{tmp_path / '00000002.log'} is missing: the batches in that part are lost, and "
        "their number is unknown"
    ]


def test_records_that_are_gone_without_a_trace_are_missed(tmp_path: Path) -> None:
    """Cut off where a record ends: the next title knows."""
    kept = journal(tmp_path, MADE)
    kept.append(arrival(MADE, 1))
    size = segments(tmp_path)[1].stat().st_size
    kept.append(arrival(MADE, 2))
    kept.rotate()
    kept.append(arrival(MADE, 3))
    os.truncate(segments(tmp_path)[1], size)
    warnings: list[str] = []
    assert sequences(tmp_path, warnings=warnings) == [1, 3]
    where = segments(tmp_path)[2]
    assert warnings == [f"{where}: what came before byte 0 is missing: 1 batch is lost"]


@pytest.mark.parametrize("other", [{"run_id": "other"}, {"made": setup(PAIR)}])
def test_another_run_or_task_is_refused(tmp_path: Path, other: dict[str, Any]) -> None:
    journal(tmp_path, MADE).append(arrival(MADE, 1))
    with pytest.raises(RunError, match="of another run, task or version"):
        read(tmp_path, **other)


def record(header: bytes, rest: bytes = b"", number: int = 0, mark: bytes = MARK) -> bytes:
    """A whole record as far as its checksums tell."""
    body = mark + len(header).to_bytes(2, "little") + header + rest
    return head(len(body), number, zlib.crc32(body)) + body


def head(length: int, number: int, checksum: int) -> bytes:
    """The head of a record, whole."""
    made = HEAD.pack(MAGIC, length, number, checksum, 0)[:-4]
    return made + zlib.crc32(made).to_bytes(4, "little")


def test_one_of_another_version_or_format_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "00000001.log"
    before = {"v": 2, "kind": "segment", "format": 3, "run_id": "run", "task": MADE.task_digest()}
    for mark in (MARK, b""):  # formats up to 6 had none
        path.write_bytes(record(msgpack.packb(before), mark=mark))
        with pytest.raises(RunError, match=r"was written by another version of tangram-rl: go on"):
            journal_run_id(tmp_path)
    [later] = Title(FORMAT + 1, "run", MADE.task_digest()).encode()
    path.write_bytes(record(later))
    with pytest.raises(RunError, match=r"is not a segment of format 7: choose another run_dir"):
        read(tmp_path)


def test_a_segment_that_cannot_be_deleted_is_told_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kept = journal(tmp_path, MADE)
    kept.append(arrival(MADE, 1))
    kept.rotate()

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        kept.drop_before(2)
    told = "00000001.log cannot be deleted (Operation not permitted): delete it yourself"
    assert caplog.messages == [f"{tmp_path}/{told}"]
    kept.append(arrival(MADE, 2))
    assert sequences(tmp_path) == [1, 2]


FORGED: dict[str, tuple[dict[str, Any], str]] = {
    "2^63-1": ({"incarnation": 2**63 - 1}, "batch: incarnation must be an integer between 1 and"),
    "2^53+1": ({"incarnation": 2**53 + 1}, "batch: incarnation must be an integer between 1 and"),
    "negative": ({"incarnation": -1}, "batch: incarnation must be an integer between 1 and"),
    "bool": ({"incarnation": True}, "batch: incarnation must be an integer between 1 and"),
    "sequence": ({"sequence": 2**53 + 1}, "episodes: sequence must be an integer between 1 and"),
    "negative sequence": ({"sequence": -1}, "episodes: sequence must be an integer between 1 and"),
    "index": ({"index": 2**16}, "batch: index must be an integer between 0 and 65535"),
    "role": ({"role": "judge"}, "batch: role must be one of player, evaluator, got 'judge'"),
    "kind": ({"kind": "bye"}, "expected batch, got a message of kind 'bye'"),
    "damage": ({"damage": 1}, "the message is damaged: its checksum is"),
    "number": ({"number": 2**64 - 1}, "it says that it is batch 18,446,744,073,709,551,615"),
    "mark": ({"mark": b""}, "the record has no mark"),
    "empty": ({"empty": 1}, "the header is not msgpack within the limits"),
}


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_record_is_left_out_and_no_reason_to_throw_the_others_away(
    tmp_path: Path, name: str
) -> None:
    """Its checksums hold, and what it says is out of bounds."""
    change, reason = FORGED[name]
    kept, one = journal(tmp_path, MADE), arrival(MADE, 2)
    kept.append(arrival(MADE, 1))
    start = segments(tmp_path)[1].stat().st_size
    frames = list(one.frames)
    if "sequence" in change:
        header = opened(frames)
        fields = {n: v for n, v in header.items() if n != "kind"}
        frames = seal(header["kind"], fields | change, frames[1:])
    if "damage" in change:
        frames[-1] = bytes([frames[-1][0] ^ 1]) + frames[-1][1:]
    entry = {"kind": "batch", "role": "player", "index": 0, "incarnation": 1, "process": "p"}
    entry |= {"owner": ""} | {
        n: v for n, v in change.items() if n in ("kind", "role", "index", "incarnation")
    }
    [packed] = seal(str(entry.pop("kind")), entry, [])
    data = b"" if "empty" in change else join_frames(frames)
    number = change.get("number", 2)
    with segments(tmp_path)[1].open("ab") as file:
        mark = change.get("mark", MARK)
        file.write(record(b"" if "empty" in change else packed, data, number, mark))
    kept.number = 2
    kept.append(arrival(MADE, 3))
    warnings: list[str] = []
    assert sequences(tmp_path, warnings=warnings) == [1, 3]
    assert len(warnings) == 1
    assert f"00000001.log is damaged at byte {start:,} ({reason}" in warnings[0]
    assert warnings[0].endswith("): 1 batch is lost")


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def fail(*_: int) -> None:
    raise OSError(errno.EIO, "Input/output error")


@pytest.mark.parametrize("room", [0, 30, 300])
def test_a_full_disk_is_told_and_leaves_whole_records(
    tmp_path: Path, disk: Disk, room: int
) -> None:
    """No room for the title, for a part of it, and for a part of the batch."""
    kept = journal(tmp_path, MADE)
    disk.room = room
    for _ in range(2):
        with pytest.raises(JournalError, match=r"cannot be written \(No space left on device\)"):
            kept.append(arrival(MADE, 1))
        assert read(tmp_path) == []
    disk.room = 10**9
    kept.append(arrival(MADE, 1))
    kept.append(arrival(MADE, 2))
    assert sequences(tmp_path) == [1, 2]


def test_a_record_that_cannot_be_taken_back_ends_its_segment(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that fails altogether: neither written on nor cut back."""
    kept = journal(tmp_path, MADE)
    kept.append(arrival(MADE, 1))
    with monkeypatch.context() as patch:
        patch.setattr(journal_module.os, "ftruncate", fail)
        disk.room = 30
        with pytest.raises(JournalError, match="No space left on device"):
            kept.append(arrival(MADE, 2))
    assert kept.exposed  # nothing was synced, so a checkpoint is due
    disk.room = 10**9
    for number in (2, 3):
        kept.append(arrival(MADE, number))
    warnings: list[str] = []
    assert sequences(tmp_path, warnings=warnings) == [1, 2, 3]
    assert len(warnings) == 1
    assert "00000001.log is cut short" in warnings[0]


def test_a_sync_that_fails_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = journal(tmp_path, MADE, sync_s=1000.0)
    kept.append(arrival(MADE, 1))
    with monkeypatch.context() as patch:
        patch.setattr(journal_module.os, "fsync", fail)
        with pytest.raises(JournalError, match="Input/output error"):
            kept.sync()
    kept.sync()


def test_a_journal_takes_what_the_wire_takes(tmp_path: Path) -> None:
    """The largest batch of a message fits a record."""
    spec = MADE.spec
    kept = journal(tmp_path, MADE)
    kept.append(arrival(MADE, 1, count=most_episodes(spec)))
    (found,) = read(tmp_path)
    assert found.episodes.count == most_episodes(spec)
