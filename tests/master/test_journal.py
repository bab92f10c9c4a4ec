"""The journal: what was appended comes back, in order, however the master ended."""

import errno
import os
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from master import journal as journal_module
from master.delivery import EpisodesArrived
from master.journal import FORMAT, HEAD, JournalError, Title, journal_run_id, read_journal, segments
from tangram_agent.arrays import EpisodeSpec
from tangram_agent.setup import Setup
from tangram_sim.errors import RunError
from tests.agent.builders import PAIR, setup, watched_disk
from tests.master.builders import arrival, close_journals, journal, small_setup

pytestmark = pytest.mark.fast

MADE = small_setup()


def read(
    folder: Path,
    warnings: list[str] | None = None,
    first: int = 1,
    run_id: str = "run",
    made: Setup = MADE,
) -> list[EpisodesArrived]:
    warn = pytest.fail if warnings is None else warnings.append
    spec = EpisodeSpec.of(made)
    return list(read_journal(folder, first, run_id, made.task_digest(), spec, warn))


def sequences(folder: Path, **more: Any) -> list[int]:
    return [found.sequence for found in read(folder, **more)]


def assert_same(one: EpisodesArrived, other: EpisodesArrived) -> None:
    for name in ("role", "index", "incarnation", "sequence", "weights_version"):
        assert getattr(one, name) == getattr(other, name), name
    for name in ("corners", "placed", "actions", "rewards", "goals"):
        ours, theirs = getattr(one.episodes, name), getattr(other.episodes, name)
        assert ours.dtype == theirs.dtype, name
        np.testing.assert_array_equal(ours, theirs, err_msg=name)


@pytest.mark.parametrize("made", [MADE, setup(PAIR)], ids=["square", "pair"])
def test_batches_come_back_as_they_were_appended(tmp_path: Path, made: Setup) -> None:
    written = [arrival(made, number, count=number, version=number - 2) for number in (1, 2, 3)]
    kept = journal(tmp_path, made)
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
    folder, file = (path.stat().st_ino for path in (tmp_path, *tmp_path.iterdir()))
    assert done == [folder, *[file] * syncs]
    kept.close()
    assert done == [folder, *[file] * max(syncs, 1)]


def test_every_life_and_every_checkpoint_begins_a_segment_and_covered_ones_are_dropped(
    tmp_path: Path,
) -> None:
    journal(tmp_path, MADE).append(arrival(MADE, 1))
    kept = journal(tmp_path, MADE)
    kept.append(arrival(MADE, 2))
    assert [kept.rotate() for _ in range(2)] == [3, 3]  # nothing came in between
    kept.append(arrival(MADE, 3))
    assert list(segments(tmp_path)) == [1, 2, 3]
    assert [sequences(tmp_path, first=n) for n in (1, 3, 4)] == [[1, 2, 3], [3], []]
    kept.drop_before(2)
    assert list(segments(tmp_path)) == [2, 3]
    kept.drop_before(99)  # never the current one
    assert list(segments(tmp_path)) == [3]
    kept.append(arrival(MADE, 4))
    assert sequences(tmp_path, first=3) == [3, 4]


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


def test_damage_in_the_middle_is_told_as_a_loss(tmp_path: Path) -> None:
    kept = journal(tmp_path, MADE)
    kept.append(arrival(MADE, 1))
    start = segments(tmp_path)[1].stat().st_size
    for number in (2, 3):
        kept.append(arrival(MADE, number))
    data = bytearray(segments(tmp_path)[1].read_bytes())
    data[start + HEAD.size + 40] ^= 1
    segments(tmp_path)[1].write_bytes(data)
    warnings: list[str] = []
    assert sequences(tmp_path, warnings=warnings) == [1]
    assert len(warnings) == 1
    assert f"is damaged at byte {start:,}: the {len(data) - start:,} bytes" in warnings[0]


@given(st.data())
def test_any_changed_bit_is_told_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("journal")
    kept = journal(folder, MADE)
    for number in (1, 2, 3):
        kept.append(arrival(MADE, number, count=1))
        kept.rotate()
    path = segments(folder)[2]
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    warnings: list[str] = []
    assert sequences(folder, warnings=warnings) == [1, 3]
    assert len(warnings) == 1


def test_missing_segments_are_told_in_one_line_and_the_others_are_read(tmp_path: Path) -> None:
    kept = journal(tmp_path, MADE)
    for number in (1, 2, 3):
        kept.append(arrival(MADE, number))
        kept.rotate()
    found = segments(tmp_path)
    found[2].unlink()
    found[3].rename(tmp_path / "100000000.log")  # more digits than others, and still the last
    journal(tmp_path / "stray", MADE).append(arrival(MADE, 4))
    segments(tmp_path / "stray")[1].rename(tmp_path / "99999999.log")
    warnings: list[str] = []
    assert sequences(tmp_path, warnings=warnings) == [1, 4, 3]
    assert warnings == [
        f"{tmp_path / '00000002.log'} and the 99,999,996 after it are missing: the batches that "
        "were in there are lost"
    ]
    (tmp_path / "99999999.log").rename(tmp_path / "00000003.log")
    warnings.clear()
    assert sequences(tmp_path, first=2, warnings=warnings) == [4, 3]
    assert warnings[0] == (
        f"{tmp_path / '00000002.log'} is missing: the batches that were in there are lost"
    )


@pytest.mark.parametrize("other", [{"run_id": "other"}, {"made": setup(PAIR)}])
def test_another_run_or_task_is_refused(tmp_path: Path, other: dict[str, Any]) -> None:
    journal(tmp_path, MADE).append(arrival(MADE, 1))
    with pytest.raises(RunError, match="of another run, task or version"):
        read(tmp_path, **other)


def record(header: bytes, rest: bytes = b"") -> bytes:
    """A whole record as far as its checksum tells."""
    body = len(header).to_bytes(2, "little") + header + rest
    return HEAD.pack(len(body), zlib.crc32(body)) + body


def test_what_is_no_journal_and_one_of_another_version_or_format_are_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "00000001.log"
    before = {"v": 2, "kind": "segment", "format": 1, "run_id": "run", "task": MADE.task_digest()}
    path.write_bytes(record(msgpack.packb(before)))
    with pytest.raises(RunError, match=r"was written by another version of tangram-rl: go on with"):
        journal_run_id(tmp_path)
    [later] = Title(FORMAT + 1, "run", MADE.task_digest()).encode()
    journal(tmp_path / "whole", MADE).append(arrival(MADE, 1))
    whole = segments(tmp_path / "whole")[1].read_bytes()
    untitled = whole[HEAD.size + HEAD.unpack_from(whole)[0] :]
    for content in (record(later), untitled):
        path.write_bytes(content)
        with pytest.raises(RunError, match=r"is no segment of format 2: choose another run_dir"):
            read(tmp_path)


def test_the_frames_are_kept_as_they_came_and_their_checksum_is_checked(tmp_path: Path) -> None:
    """What was damaged before it was written, or by whoever wrote the record anew."""
    one, kept = arrival(MADE, 1), journal(tmp_path, MADE)
    kept.append(one)
    content = segments(tmp_path)[1].read_bytes()
    assert all(frame in content for frame in one.frames)
    assert list(read(tmp_path)[0].frames) == list(one.frames)
    bad = [*one.frames[:-1], bytes([one.frames[-1][0] ^ 1]) + one.frames[-1][1:]]
    kept.append(replace(one, frames=bad))
    reason = r"holds what cannot be read \(the message is damaged: its ch"
    with pytest.raises(RunError, match=reason):
        read(tmp_path)


class Disk:
    """Writes as long as there is room; stands in for os-level writes of a file."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.room = 10**9
        opened, disk = journal_module.FileIO, self

        class Full(opened):  # type: ignore[misc, valid-type]
            def write(self, data: memoryview) -> int:
                if not disk.room:
                    raise OSError(errno.ENOSPC, "No space left on device")
                size = min(len(data), disk.room)
                disk.room -= size
                return int(os.write(self.fileno(), data[:size]))

        monkeypatch.setattr(journal_module, "FileIO", Full)


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
    spec = EpisodeSpec.of(MADE)
    kept = journal(tmp_path, MADE)
    kept.append(arrival(MADE, 1, count=spec.max_count))
    (found,) = read(tmp_path)
    assert found.episodes.count == spec.max_count
