"""The journal: every batch is on disk before it is acknowledged, so that a kill loses none.

A folder of segments, `00000001.log` and on. A new one begins with each life of the master and with
each checkpoint, and a checkpoint names the first segment that it does not cover. A restart inserts
what stands in the segments from there on, in the order of the first time.

A segment is a row of records: bytes of the body and its CRC-32 (two little-endian u32), then the
body. The first one says which run and task it is of; each other one holds one batch, a msgpack
header behind its length (u16), then the raw arrays of the wire.

A record goes to the operating system at once, so that it outlives the process; it is synced to the
disk at an interval, so a machine that loses power may lose what came since.
"""

import os
import struct
import zlib
from contextlib import suppress
from io import FileIO
from pathlib import Path

from master.arrivals import EpisodesArrived
from tangram_agent.frames import pack_header
from tangram_agent.payloads import EpisodeSpec, encode_episodes
from tangram_agent.process import Every
from tangram_sim.errors import RunError

FORMAT = 1
SUFFIX = ".log"
DIGITS = 8
HEAD = struct.Struct("<II")
LENGTH = struct.Struct("<H")


class JournalError(RunError):
    """The journal cannot be written: nothing may be acknowledged until it can."""


class Journal:
    """The end at which batches are added.

    Attributes:
        segment: number of the segment that the next batch goes to.
    """

    def __init__(
        self, folder: Path, run_id: str, task: str, spec: EpisodeSpec, sync_s: float
    ) -> None:
        """Nothing is written before the first batch.

        Args:
            folder: of the segments, made if it is missing.
            run_id: of the run.
            task: digest of what the arrays belong to.
            spec: of the arrays.
            sync_s: seconds between two syncs, 0 to sync each batch.
        """
        self._folder, self._spec = folder, spec
        self._title = {"format": FORMAT, "run_id": run_id, "task": task}
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
        header = {
            "role": arrival.role,
            "index": arrival.index,
            "incarnation": arrival.incarnation,
            "sequence": arrival.sequence,
            "weights_version": arrival.weights_version,
            "count": arrival.episodes.count,
        }
        arrays = encode_episodes(arrival.episodes, self._spec)
        try:
            self._write(self._file or self._begin(), _record("batch", header, arrays))
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
        self._good = 0
        self._write(self._file, _record("segment", self._title, []))
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
    return {int(path.stem): path for path in sorted(paths) if path.stem.isdecimal()}


def segment_path(folder: Path, number: int) -> Path:
    """Where a segment lies."""
    return folder / f"{number:0{DIGITS}d}{SUFFIX}"


def _record(kind: str, fields: dict[str, object], arrays: list[bytes]) -> bytes:
    header = pack_header(kind, fields)
    body = b"".join([LENGTH.pack(len(header)), header, *arrays])
    return HEAD.pack(len(body), zlib.crc32(body)) + body
