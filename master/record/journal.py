"""The journal: every batch is written before it is acknowledged, so that a kill loses none.

The journal is a folder of segments, `00000001.log` and so on. Each checkpoint starts a new segment,
and stores its number as the first segment that the checkpoint does not cover. A resumed master
appends to the newest segment. `recovery` reads the segments.

A segment is a sequence of records. A record is a head and a body. The head: a magic number, the
length of the body, the number of the record, a CRC-32 of the body and a CRC-32 of the head itself.
Batches are numbered from 1 over all segments and processes of a run. A title has the number of the
batch before it. Later formats must not change the head.

The body: a mark, the length of a header (u16), the header, and for a batch its frames. No message
may have the mark in it, so after damage it shows where the next record begins. Headers are declared
and read like those of messages. A title names the run and the task of the batches after it; each
segment and each master process begins with one. The header of a batch names its sender. The frames
follow as they arrived, with their own checksum, which is checked again when they are read.

A record goes to the operating system at once, so it survives the end of the process. It is synced
to the disk at intervals, so a power cut may lose the newest records.
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
from tangram_core.run.process import Every, still_alive
from tangram_core.store.files import is_same, make_folders, sync_folder
from tangram_core.wire.arrays import join_frames
from tangram_core.wire.messages import Count, Id, Index, Number, Role
from tangram_core.wire.schema import MAX_COUNT, Message

FORMAT = 7
SUFFIX = ".log"
DIGITS = 8
MAGIC = b"\xf1TJ\n"
MARK = b"\x9b\xf6\xd2\x8e\xc5\xb1\xe9\xa7"  # no byte of it is in a text or begins a number
HEAD = struct.Struct("<4sIQII")
LENGTH = struct.Struct("<H")
CRC = struct.Struct("<I")


@dataclass(frozen=True)
class Place:
    """Position of a checkpoint in the journal.

    Attributes:
        segment: number of the first segment that the checkpoint does not cover.
        number: number of the last batch before that segment.
    """

    segment: Annotated[int, msgspec.Meta(ge=1, le=MAX_COUNT)] = 1
    number: Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNT)] = 0


@dataclass(frozen=True)
class Title(Message):
    """Header of a title: format, run, and task as a digest of the settings without the agent's."""

    kind: ClassVar[str] = "segment"
    format: Count
    run_id: Id
    task: Id


@dataclass(frozen=True)
class Entry(Message):
    """Header of a batch: its sender."""

    kind: ClassVar[str] = "batch"
    role: Role
    index: Index
    incarnation: Number
    process: Id
    owner: Id


log = logging.getLogger(__name__)


class JournalError(RunError):
    """The journal cannot be written; until it can, no batch may be acknowledged."""


class Journal:
    """Appends batches to the journal.

    Attributes:
        segment: number of the segment for the next batch.
        number: number of the last batch.
        exposed: whether batches since the last checkpoint may be lost, so that a checkpoint is due.
    """

    def __init__(
        self,
        folder: Path,
        run_id: str,
        task: str,
        sync_s: float,
        after: Place | None = None,
        torn: int | None = None,
    ) -> None:
        """Open the newest segment, if there is one; a new segment is made with the first batch.

        Args:
            folder: of the segments, made if it is missing; its parent folder must exist.
            run_id: of the run.
            task: digest of the settings without the agent's.
            sync_s: seconds between two syncs, 0 to sync each batch.
            after: segment of the checkpoint, and number of the last batch; None for a new run.
            torn: where an unfinished record begins that is to be cut off the newest segment.

        Raises:
            JournalError: the segment cannot be opened or written.
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
        if (path := segment_path(folder, self.segment)).exists():
            if torn is not None:
                try:
                    os.truncate(path, torn)
                except OSError as error:
                    raise self._broken(error) from None
            self._begin()

    def append(self, arrival: EpisodesArrived) -> None:
        """Append a batch to the open segment, and sync if a sync is due.

        Raises:
            JournalError: the disk is full or broken. A part that was written is removed. If the
                batch is on the disk nevertheless, a restart drops the duplicate.
        """
        who = (arrival.role, arrival.index, arrival.incarnation)
        entry = Entry(*who, arrival.process, arrival.owner)
        file = self._file or self._begin()
        self._write(file, _record(entry, self.number + 1, arrival.frames))
        self.number += 1
        self._bare, self._dirty = False, True
        self.tick()

    def tick(self) -> None:
        """Sync if a sync is due; JournalError as in `sync`."""
        if self._dirty and self._sync.due():
            self.sync()

    def sync(self) -> None:
        """Wait until all records are on the disk.

        Raises:
            JournalError: the sync failed. It is unknown which records are on the disk, and a
                second sync would not show it, so the next batches go to a new segment.
        """
        if self._file is not None and self._dirty:
            try:
                os.fsync(self._file.fileno())
            except OSError as error:
                self.abandon()
                raise self._broken(error) from None
            self._dirty = False

    def in_place(self) -> bool:
        """Whether the open segment is still the file with its name; True if none is open."""
        path = segment_path(self._folder, self.segment)
        return self._file is None or is_same(self._file.fileno(), path)

    def abandon(self) -> None:
        """Close the open segment without a sync, and mark its batches as possibly lost."""
        self._drop()
        self.segment += 1
        self.exposed = True

    def rotate(self) -> Place:
        """Begin a new segment unless the present one is empty; JournalError as in `append`.

        Returns:
            The position after the last batch.
        """
        if self._file is not None and not self._bare:
            self.close()
            self.segment += 1
        if self._file is None:
            self._begin()
        return Place(self.segment, self.number)

    def drop_before(self, segment: int) -> None:
        """Delete the segments before a number, never the open one; log a warning if that fails."""
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
        """Open the segment, and write and sync its title: a checkpoint may refer to it."""
        try:
            make_folders(self._folder, above=False)
            # Append: an earlier process may have left records, or a part of a title.
            file = FileIO(segment_path(self._folder, self.segment), "a")
            self._good = os.fstat(file.fileno()).st_size
        except OSError as error:
            raise self._broken(error) from None
        self._file, self._bare = file, self._good == 0
        try:
            # If the folder is not synced, a power cut can lose the name of the file.
            sync_folder(self._folder)
            still_alive()  # FailedError if another machine began the segment by now
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
        """Append a record; on JournalError, the part that was written is removed."""
        left = memoryview(record)
        try:
            while left:  # if the disk is nearly full, a write may be partial
                left = left[file.write(left) or 0 :]
        except OSError as error:
            try:
                os.ftruncate(file.fileno(), self._good)
            except OSError:
                self.abandon()
            raise self._broken(error) from None
        self._good += len(record)

    def _drop(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None
        self._dirty = False

    def _broken(self, error: OSError) -> JournalError:
        return JournalError(f"the journal in {self._folder} cannot be written ({error.strerror})")


def segments(folder: Path) -> dict[int, Path]:
    """Number -> path of each segment, in order of the numbers."""
    paths = folder.glob(f"*{SUFFIX}") if folder.is_dir() else ()
    return dict(sorted((int(path.stem), path) for path in paths if path.stem.isdecimal()))


def segment_path(folder: Path, number: int) -> Path:
    """The path of a segment."""
    return folder / f"{number:0{DIGITS}d}{SUFFIX}"


def _record(header: Title | Entry, number: int, frames: Sequence[bytes]) -> bytes:
    [packed] = header.encode()
    body = b"".join([MARK, LENGTH.pack(len(packed)), packed, join_frames(frames)])
    head = HEAD.pack(MAGIC, len(body), number, zlib.crc32(body), 0)[: -CRC.size]
    return head + CRC.pack(zlib.crc32(head)) + body
