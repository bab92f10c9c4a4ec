"""The journal: every batch is on disk before it is acknowledged, so that a kill loses none.

A folder of segments, `00000001.log` and on. A new one begins with each life of the master and with
each checkpoint, and a checkpoint names the first segment that it does not cover. A restart inserts
what stands in the segments from there on, in the order of the first time.

A segment is a row of records: bytes of the body and its CRC-32 (two little-endian u32), then the
body: a header behind its length (u16), declared and read like those of messages. The header of the
first record says which run and task the segment is of. That of each other one says who sent the
batch whose frames follow, joined, just as they came: with their own checksum, which is checked
again when they are read.

A record goes to the operating system at once, so that it outlives the process; it is synced to the
disk at an interval, so a machine that loses power may lose what came since.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any, ClassVar

from master.delivery import EpisodesArrived
from tangram_agent.arrays import MAX_BATCH_BYTES, MAX_FRAMES, EpisodeSpec, join_frames, split_frames
from tangram_agent.files import sync_folder
from tangram_agent.messages import Count, EpisodeBatch, Id, Index, Number, Role, decode_from_worker
from tangram_agent.process import Every
from tangram_agent.schema import MAX_HEADER, Plain, ProtocolError, opened, read
from tangram_sim.errors import RunError, WireError

FORMAT = 2
SUFFIX = ".log"
DIGITS = 8
HEAD = struct.Struct("<II")
LENGTH = struct.Struct("<H")
MAX_BODY = LENGTH.size + MAX_HEADER + MAX_BATCH_BYTES + MAX_HEADER + 4 * MAX_FRAMES
Header = Mapping[str, Any]
ANOTHER = "choose another run_dir, or delete its folder journal to go on without it"


@dataclass(frozen=True)
class Title(Plain):
    """What a segment is of.

    Attributes:
        format: of the journal.
        run_id: of the run.
        task: digest of what the arrays belong to.
    """

    kind: ClassVar[str] = "segment"
    format: Count
    run_id: Id
    task: Id


@dataclass(frozen=True)
class Entry(Plain):
    """Who sent the batch that follows."""

    kind: ClassVar[str] = "batch"
    role: Role
    index: Index
    incarnation: Number


class JournalError(RunError):
    """The journal cannot be written: nothing may be acknowledged until it can."""


class Journal:
    """Appends batches to the journal.

    Attributes:
        segment: number of the segment that the next batch goes to.
    """

    def __init__(self, folder: Path, run_id: str, task: str, sync_s: float) -> None:
        """Nothing is written before the first batch.

        Args:
            folder: of the segments, made if it is missing.
            run_id: of the run.
            task: digest of what the arrays belong to.
            sync_s: seconds between two syncs, 0 to sync each batch.
        """
        self._folder, self._title = folder, Title(FORMAT, run_id, task)
        self._file: FileIO | None = None
        self._good = 0  # bytes of whole records
        self._dirty, self._sync = False, Every(sync_s)
        self.segment = max(segments(folder), default=0) + 1

    def append(self, arrival: EpisodesArrived) -> None:
        """Hand a batch to the operating system.

        Raises:
            JournalError: the disk is full or broken. What was written of it is taken back; where
                it may have been written after all, a restart drops what it has twice.
        """
        entry = Entry(arrival.role, arrival.index, arrival.incarnation)
        try:
            self._write(self._file or self._begin(), _record(entry, arrival.frames))
        except OSError as error:
            self._take_back()
            raise self._broken(error) from None
        self._dirty = True
        self.tick()

    def tick(self) -> None:
        """Sync when it is time; JournalError as in `sync`."""
        if self._dirty and self._sync.due():
            self.sync()

    def sync(self) -> None:
        """Wait until the disk has it all; JournalError if it does not take it."""
        if self._file is not None and self._dirty:
            try:
                os.fsync(self._file.fileno())
            except OSError as error:
                raise self._broken(error) from None
            self._dirty = False

    def rotate(self) -> int:
        """Begin a new segment with the next batch; returns its number."""
        if self._file is not None:
            self.close()
            self.segment += 1
        return self.segment

    def drop_before(self, segment: int) -> None:
        """Delete the segments below a number, which checkpoints cover."""
        for number, path in segments(self._folder).items():
            if number < min(segment, self.segment):
                path.unlink()

    def close(self) -> None:
        """Sync, and close the file."""
        if self._file is not None:
            self.sync()
            self._file.close()
            self._file = None

    def _begin(self) -> FileIO:
        self._folder.mkdir(parents=True, exist_ok=True)
        # Not "x": a segment that could not be begun for want of room may lie there.
        self._file = FileIO(segment_path(self._folder, self.segment), "w")
        # Bytes that are synced into a file without a name would be lost with the power.
        sync_folder(self._folder)
        self._good = 0
        self._write(self._file, _record(self._title, []))
        return self._file

    def _write(self, file: FileIO, record: bytes) -> None:
        left = memoryview(record)
        while left:  # a disk that fills up takes a part of it
            left = left[file.write(left) or 0 :]
        self._good += len(record)

    def _take_back(self) -> None:
        """Cut off a record that was written in part; where that fails, too, go on in a new file."""
        if self._file is None:
            return
        try:
            os.ftruncate(self._file.fileno(), self._good)
            self._file.seek(self._good)
        except OSError:
            self._drop()
            self.segment += 1  # a record that is cut short ends the one before
        else:
            if not self._good:
                self._drop()

    def _drop(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None

    def _broken(self, error: OSError) -> JournalError:
        return JournalError(f"the journal in {self._folder} cannot be written ({error.strerror})")


def segments(folder: Path) -> dict[int, Path]:
    """Number -> path of the segments, in order."""
    paths = folder.glob(f"*{SUFFIX}") if folder.is_dir() else ()
    return dict(sorted((int(path.stem), path) for path in paths if path.stem.isdecimal()))


def segment_path(folder: Path, number: int) -> Path:
    """Where a segment lies."""
    return folder / f"{number:0{DIGITS}d}{SUFFIX}"


def _record(header: Title | Entry, frames: Sequence[bytes]) -> bytes:
    [packed] = header.encode()
    body = b"".join([LENGTH.pack(len(packed)), packed, join_frames(frames)])
    return HEAD.pack(len(body), zlib.crc32(body)) + body


# Reading it back


def journal_run_id(folder: Path) -> str | None:
    """The run that a journal is of; None where there is no journal, or nothing whole in it.

    Raises:
        RunError: it is of another format.
    """
    for path in segments(folder).values():
        for header, _ in _records(path, lambda _: None):
            return _title(path, header)[0]
    return None


def check_journal(folder: Path, task: str) -> None:
    """Raise RunError if there is a journal of another task or format."""
    for path in segments(folder).values():
        for header, _ in _records(path, lambda _: None):
            if _title(path, header)[1] != task:
                raise _of_another(path)
            break


def _of_another(path: Path) -> RunError:
    return RunError(f"{path} is of another run, task or version of tangram-rl: {ANOTHER}")


def read_journal(
    folder: Path,
    first: int,
    run_id: str,
    task: str,
    spec: EpisodeSpec,
    warn: Callable[[str], None],
) -> Iterator[EpisodesArrived]:
    """The batches from a segment on, in the order in which they were added.

    Args:
        folder: of the segments.
        first: number of the segment to begin with.
        run_id: that the segments must be of.
        task: digest that they must carry.
        spec: of the arrays.
        warn: takes lines for the user: a record that was cut short, a segment that is missing.

    Raises:
        RunError: another run, task or format.
    """
    expected = first
    for number, path in segments(folder).items():
        if number < first:
            continue
        if number > expected:
            warn(_missing(segment_path(folder, expected), number - expected))
        expected = number + 1
        yield from _segment(path, run_id, task, spec, warn)


def _missing(path: Path, count: int) -> str:
    more = f" and the {count - 1:,} after it are" if count > 1 else " is"
    return f"{path}{more} missing: the batches that were in there are lost"


def _segment(
    path: Path, run_id: str, task: str, spec: EpisodeSpec, warn: Callable[[str], None]
) -> Iterator[EpisodesArrived]:
    records = _records(path, warn)
    for header, _ in records:
        if _title(path, header) != (run_id, task):
            raise _of_another(path)
        break
    for header, frames in records:
        try:
            yield _batch(header, frames, spec)
        except WireError as error:
            raise _unreadable(path, error) from None


def _records(path: Path, warn: Callable[[str], None]) -> Iterator[tuple[Header, bytes]]:
    """Header and joined frames of each record, up to one that is not whole."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start = 0
        while start < size:
            head = file.read(HEAD.size)
            length, checksum = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
            body = file.read(min(length, MAX_BODY))
            if len(body) != length or length < LENGTH.size or zlib.crc32(body) != checksum:
                whole = len(head) == HEAD.size and start + HEAD.size + length <= size
                warn(_damaged(path, start, size) if whole else _cut_short(path, size - start))
                return
            start = file.tell()
            yield _parts(path, body)


def _cut_short(path: Path, size: int) -> str:
    return (
        f"the last record of {path} is cut short ({size:,} bytes), as a kill leaves it: dropped, "
        "it was not acknowledged"
    )


def _damaged(path: Path, start: int, size: int) -> str:
    return (
        f"{path} is damaged at byte {start:,}: the {size - start:,} bytes from there on "
        "are lost, with the batches in them"
    )


def _parts(path: Path, body: bytes) -> tuple[Header, bytes]:
    (length,) = LENGTH.unpack_from(body)
    split = LENGTH.size + length
    try:
        return opened([body[LENGTH.size : split]]), body[split:]
    except ProtocolError:
        raise RunError(
            f"{path} was written by another version of tangram-rl: go on with that, or {ANOTHER}"
        ) from None
    except WireError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: WireError) -> RunError:
    return RunError(f"{path} holds what cannot be read ({error}): {ANOTHER}")


def _title(path: Path, header: Header) -> tuple[str, str]:
    """Run id and task of a segment."""
    if header["kind"] != Title.kind or header.get("format") != FORMAT:
        raise RunError(f"{path} is no segment of format {FORMAT}: {ANOTHER}")
    try:
        title = read(Title, header)
    except WireError as error:
        raise RunError(f"{path} is no journal ({error}): {ANOTHER}") from None
    return title.run_id, title.task


def _batch(header: Header, data: bytes, spec: EpisodeSpec) -> EpisodesArrived:
    entry, frames = read(Entry, header), split_frames(data)
    batch = decode_from_worker(frames, spec)
    if not isinstance(batch, EpisodeBatch):
        raise WireError(f"a message of kind {batch.kind!r}")
    return EpisodesArrived(entry.role, entry.index, entry.incarnation, batch, frames)
