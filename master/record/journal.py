"""The journal: every batch is on disk before it is acknowledged, so that a kill loses none.

A folder of segments, `00000001.log` and on. A checkpoint begins the next one, and names it as the
first that it does not cover; a life of the master that goes on appends to the newest. See
`recovery` for how they are read.

A segment is a row of records, each a head and a body. The head: a magic, the length of the body,
the number of the record, and a CRC-32 each of the body and of the head itself. Batches are numbered
from 1 on, over all segments and lives of a run; a title carries the number of the batch before it.
The head stays as it is in later formats.

The body: a header behind its length (u16), declared and read like those of messages. The header of
a title says which run and task what follows is of; each life begins with one, and each segment.
That of a batch says who sent the batch whose frames follow, joined, just as they came: with their
own checksum, which is checked again when they are read.

A record goes to the operating system at once, so that it outlives the process; it is synced to the
disk at an interval, so a machine that loses power may lose what came since.
"""

import logging
import os
import struct
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec

from master.record.delivery import EpisodesArrived
from tangram_core.errors import RunError
from tangram_core.run.process import Every
from tangram_core.store.files import is_same, make_folders, sync_folder
from tangram_core.wire.arrays import join_frames
from tangram_core.wire.messages import Count, Id, Index, Number, Role
from tangram_core.wire.schema import MAX_COUNT, Message

FORMAT = 5  # 4 had no owners
SUFFIX = ".log"
DIGITS = 8
MAGIC = b"\xf1TJ\n"
HEAD = struct.Struct("<4sIQII")
LENGTH = struct.Struct("<H")
CRC = struct.Struct("<I")


@dataclass(frozen=True)
class Place:
    """Where a checkpoint stands in the journal.

    Attributes:
        segment: the first one that it does not cover.
        number: of the last batch before that.
    """

    segment: Annotated[int, msgspec.Meta(ge=1, le=MAX_COUNT)] = 1
    number: Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNT)] = 0


@dataclass(frozen=True)
class Title(Message):
    """What a segment is of; the task is a digest of what the arrays belong to."""

    kind: ClassVar[str] = "segment"
    format: Count
    run_id: Id
    task: Id


@dataclass(frozen=True)
class Entry(Message):
    """Who sent the batch that follows."""

    kind: ClassVar[str] = "batch"
    role: Role
    index: Index
    incarnation: Number
    process: Id
    owner: Id


log = logging.getLogger(__name__)


class JournalError(RunError):
    """The journal cannot be written: nothing may be acknowledged until it can."""


class Journal:
    """Appends batches to the journal.

    Attributes:
        segment: number of the segment that the next batch goes to.
        number: of the last batch.
        exposed: what it took since the last checkpoint may be gone: the next one is due at once.
    """

    def __init__(
        self, folder: Path, run_id: str, task: str, sync_s: float, after: Place | None = None
    ) -> None:
        """Nothing is written before the first batch, unless a life before this one has.

        Args:
            folder: of the segments, made if it is missing; what it is in must be there.
            run_id: of the run.
            task: digest of what the arrays belong to.
            sync_s: seconds between two syncs, 0 to sync each batch.
            after: segment that a checkpoint names, and the number of the last batch.

        Raises:
            JournalError: the segment cannot be gone on with.
        """
        self._folder, self._title = folder, Title(FORMAT, run_id, task)
        self._file: FileIO | None = None
        self._good = 0  # bytes of whole records
        self._bare = True  # holds nothing but its title
        self._dirty, self._sync = False, Every(sync_s)
        self.exposed = False
        known = after or Place()
        self.segment = max([known.segment, *segments(folder)])
        self.number = known.number
        if segment_path(folder, self.segment).exists():
            self._begin()

    def append(self, arrival: EpisodesArrived) -> None:
        """Hand a batch to the operating system.

        Raises:
            JournalError: the disk is full or broken. What was written of it is taken back; where
                it may have been written after all, a restart drops what it has twice.
        """
        who = (arrival.role, arrival.index, arrival.incarnation)
        entry = Entry(*who, arrival.process, arrival.owner)
        file = self._file or self._begin()
        self._write(file, _record(entry, self.number + 1, arrival.frames))
        self.number += 1
        self._bare, self._dirty = False, True
        self.tick()

    def tick(self) -> None:
        """Sync when it is time; JournalError as in `sync`."""
        if self._dirty and self._sync.due():
            self.sync()

    def sync(self) -> None:
        """Wait until the disk has it all.

        Raises:
            JournalError: it does not take it. Nobody knows what it has then, and syncing again
                would not tell: what follows goes to a new segment.
        """
        if self._file is not None and self._dirty:
            try:
                os.fsync(self._file.fileno())
            except OSError as error:
                self.abandon()
                raise self._broken(error) from None
            self._dirty = False

    def in_place(self) -> bool:
        """Whether the open segment still is what lies under its name."""
        path = segment_path(self._folder, self.segment)
        return self._file is None or is_same(self._file.fileno(), path)

    def abandon(self) -> None:
        """Leave the open segment: what it holds may be gone."""
        self._drop()
        self.segment += 1
        self.exposed = True

    def rotate(self) -> Place:
        """Begin a new segment, unless this one is new; JournalError as in `append`."""
        if self._file is not None and not self._bare:
            self.close()
            self.segment += 1
        if self._file is None:
            self._begin()
        return Place(self.segment, self.number)

    def drop_before(self, segment: int) -> None:
        """Delete the segments below a number, which checkpoints cover; it is told if that fails."""
        for number, path in segments(self._folder).items():
            try:
                if number < min(segment, self.segment):
                    path.unlink(missing_ok=True)
            except OSError as error:
                log.warning("%s cannot be deleted (%s): delete it yourself", path, error.strerror)

    def close(self) -> None:
        """Sync, and close the file."""
        if self._file is not None:
            self.sync()
            self._file.close()
            self._file = None

    def _begin(self) -> FileIO:
        """Open the segment, and write its title for good: a checkpoint may name it."""
        try:
            make_folders(self._folder, above=False)
            # What lies there is kept: of a life before, or of a title without room.
            file = FileIO(segment_path(self._folder, self.segment), "a")
            self._good = os.fstat(file.fileno()).st_size
        except OSError as error:
            raise self._broken(error) from None
        self._file, self._bare = file, self._good == 0
        try:
            # Bytes that are synced into a file without a name would be lost with the power.
            sync_folder(self._folder)
            self._write(file, _record(self._title, self.number, []))
            os.fsync(file.fileno())
        except OSError as error:
            self._drop()
            raise self._broken(error) from None
        except JournalError:
            self._drop()
            raise
        return file

    def _write(self, file: FileIO, record: bytes) -> None:
        """Append a record; JournalError if it does not fit, and what was written is taken back."""
        left = memoryview(record)
        try:
            while left:  # a disk that is nearly full takes a part of it
                left = left[file.write(left) or 0 :]
        except OSError as error:
            self._take_back(file)
            raise self._broken(error) from None
        self._good += len(record)

    def _take_back(self, file: FileIO) -> None:
        """Cut off what was written in part; where that fails, too, go on in a new file."""
        try:
            os.ftruncate(file.fileno(), self._good)
        except OSError:
            self._drop()
            self.segment += 1

    def _drop(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None
        self._dirty = False

    def _broken(self, error: OSError) -> JournalError:
        return JournalError(f"the journal in {self._folder} cannot be written ({error.strerror})")


def segments(folder: Path) -> dict[int, Path]:
    """Number -> path of the segments, in order."""
    paths = folder.glob(f"*{SUFFIX}") if folder.is_dir() else ()
    return dict(sorted((int(path.stem), path) for path in paths if path.stem.isdecimal()))


def segment_path(folder: Path, number: int) -> Path:
    """Where a segment lies."""
    return folder / f"{number:0{DIGITS}d}{SUFFIX}"


def _record(header: Title | Entry, number: int, frames: Sequence[bytes]) -> bytes:
    [packed] = header.encode()
    body = b"".join([LENGTH.pack(len(packed)), packed, join_frames(frames)])
    head = HEAD.pack(MAGIC, len(body), number, zlib.crc32(body), 0)[: -CRC.size]
    return head + CRC.pack(zlib.crc32(head)) + body
