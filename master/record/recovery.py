"""Reading the journal: what was acknowledged after a checkpoint, and what of it is lost.

A restart inserts what stands in the segments from the checkpoint's on, in the order of the first
time. Damage ends with the record that it is in: what follows is found by its magic, and the numbers
of the records tell how many batches are missing. See `journal` for what a segment looks like.
"""

import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from master.record.delivery import EpisodesArrived
from master.record.journal import (
    CRC,
    FORMAT,
    HEAD,
    LENGTH,
    MAGIC,
    Entry,
    Place,
    Title,
    segment_path,
    segments,
)
from tangram_core.errors import RunError, WireError
from tangram_core.spec import EpisodeSpec
from tangram_core.wire.arrays import split_frames
from tangram_core.wire.messages import EpisodeBatch, decode_from_worker
from tangram_core.wire.schema import ProtocolError, opened, read

CHUNK = 2**20
MAX_GAP = 2**32  # a number further on than this was forged
ANOTHER = "choose another run_dir, or delete its folder journal to go on without it"


def journal_run_id(folder: Path) -> str | None:
    """The run that a journal is of; None where there is none. RunError if of another format."""
    return next((title.run_id for _, title in _titles(folder)), None)


def check_journal(folder: Path, task: str) -> None:
    """Raise RunError if there is a journal of another task or format."""
    for path, title in _titles(folder):
        if title.task != task:
            raise _of_another(path)


def _titles(folder: Path) -> Iterator[tuple[Path, Title]]:
    """The first title of each segment that has one."""
    for path in segments(folder).values():
        for found in _scan(path):
            with suppress(WireError):
                title = _title(path, found)
                if title is not None:
                    yield path, title
                    break


def _of_another(path: Path) -> RunError:
    return RunError(f"{path} is of another run, task or version of tangram-rl: {ANOTHER}")


class Reader:
    """The batches from a place on, in the order in which they were added.

    What is read is synced first, since its senders will be told that it was inserted before: the
    life that wrote it may have been killed before its sync.

    Attributes:
        number: of the last batch that was found, or known to be lost.
    """

    def __init__(
        self,
        folder: Path,
        after: Place | None,
        run_id: str,
        task: str,
        spec: EpisodeSpec,
        warn: Callable[[str], None],
    ) -> None:
        """Read nothing yet.

        Args:
            folder: of the segments.
            after: which a checkpoint names; None for the whole journal.
            run_id, task: that the segments must be of.
            spec: of the arrays.
            warn: takes a line for each loss, and for a record that was cut short.
        """
        self._folder, self._owner, self._spec, self._warn = folder, (run_id, task), spec, warn
        self._named, known = after is not None, after or Place()
        self._first, self.number = known.segment, known.number
        self._trouble: _Trouble | None = None

    def __iter__(self) -> Iterator[EpisodesArrived]:
        """Read; RunError for another run, task or format, or a disk that cannot be read."""
        try:
            found = {n: p for n, p in segments(self._folder).items() if n >= self._first}
            expected = self._first
            for number, path in found.items():
                if number > expected:
                    self._lost(_missing(segment_path(self._folder, expected), number - expected))
                expected = number + 1
                yield from self._segment(path)
            if self._named and not found:
                self._lost(_missing(segment_path(self._folder, expected), 1))
        except OSError as error:
            raise RunError(
                f"the journal in {self._folder} cannot be read ({error.strerror}): mend the disk, "
                f"or {ANOTHER}"
            ) from None
        self._end()

    def _segment(self, path: Path) -> Iterator[EpisodesArrived]:
        for found in _scan(path):
            where = f"{path} is damaged at byte {found.start:,}"
            if found.number - self.number > MAX_GAP:
                self._lost(f"{where} (it says that it is batch {found.number:,})")
                continue
            if found.body is None:
                size = f"{found.end - found.start:,} bytes"
                torn = f"{path} is cut short at byte {found.start:,} ({size}), as a kill leaves it"
                torn += ": dropped, it was not acknowledged"
                self._lost(where, found.number, torn if found.torn else "")
                continue
            try:
                title = _title(path, found)
                batch = None if title else _batch(found.body, self._spec)
            except WireError as error:
                self._lost(f"{where} ({error})", found.number)
                continue
            if title is not None and (title.run_id, title.task) != self._owner:
                raise _of_another(path)
            before = found.number - (batch is not None)
            self._reached(before, path, found.start, another_life=title is not None)
            if batch is not None:
                self.number = max(self.number, found.number)
                yield batch

    def _lost(self, where: str, number: int = 0, torn: str = "") -> None:
        """Something is missing; how much shows when the next whole record is found."""
        last = self._trouble
        if last is None:
            self._trouble = _Trouble(where, number, torn, number > 0)
        else:
            torn = last.torn if last.torn and torn else ""
            self._trouble = _Trouble(last.where, max(last.number, number), torn, number > 0)

    def _reached(self, number: int, path: Path, start: int, another_life: bool) -> None:
        """So many batches came before this byte."""
        trouble, missing = self._trouble, number - self.number
        # A life counts on from what it could read of the one before.
        counted = another_life and start > 0
        if missing > 0:
            where = f"{path}: what came before byte {start:,} is missing"
            least = counted and trouble is not None and not trouble.whole
            told = _batches(missing, least)
            self._warn(f"{where if trouble is None else trouble.where}: {told} lost")
        elif trouble is not None:
            self._tell(trouble, "" if counted else "no batch is lost")
        self._trouble, self.number = None, max(self.number, number)

    def _end(self) -> None:
        if self._trouble is not None:
            missing = self._trouble.number - self.number
            known = f"{_batches(missing, not self._trouble.whole)} lost" if missing > 0 else ""
            self._tell(self._trouble, known)
            self.number += max(0, missing)

    def _tell(self, trouble: "_Trouble", known: str) -> None:
        unknown = "the batches that were in there are lost, and nobody knows how many"
        self._warn(trouble.torn or f"{trouble.where}: {known or unknown}")


class _Trouble(NamedTuple):
    """A part of the journal that is not as it was written.

    Attributes:
        where: it is, for people.
        number: of the last batch that is known to have been in there, 0 for none.
        torn: what is said instead where nothing was lost: a kill has left it so.
        whole: it ends with a record whose head is whole, so that no later batch was in there.
    """

    where: str
    number: int
    torn: str
    whole: bool


class _Found(NamedTuple):
    """A part of a segment: a record, or what is none.

    Attributes:
        start, end: bytes.
        number: of the record, 0 where its head is damaged or its end is missing.
        body: None where it is damaged.
        torn: it ends as a kill leaves it.
    """

    start: int
    end: int
    number: int
    body: bytes | None
    torn: bool


def _scan(path: Path) -> Iterator[_Found]:
    """All parts of a segment, in order."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        start, size = 0, os.fstat(file.fileno()).st_size
        while start < size:
            file.seek(start)
            head = _read_head(file.read(HEAD.size))
            length, number, checksum = head or (0, 0, 0)
            end = start + HEAD.size + length
            # Not asked for where it cannot be: room for it is taken first, 4 GiB of a forged head.
            body = file.read(length) if end <= size else b""
            if head is not None and len(body) == length and zlib.crc32(body) == checksum:
                yield _Found(start, end, number, body, torn=False)
            elif head is not None:
                # Where the next life has written on, its title begins within the torn record.
                whole = end <= (end := min(end, _next_head(file, start + 1, size)))
                yield _Found(start, end, number if whole else 0, None, not whole)
            else:
                end = _next_head(file, start + 1, size)
                yield _Found(start, end, 0, None, end - start < HEAD.size)
            start = end


def _read_head(head: bytes) -> tuple[int, int, int] | None:
    """Length, number and checksum of a body; None where the head is not whole."""
    if len(head) < HEAD.size:
        return None
    magic, length, number, checksum, own = HEAD.unpack(head)
    if magic != MAGIC or own != zlib.crc32(head[: -CRC.size]):
        return None
    return length, number, checksum


def _next_head(file: BinaryIO, start: int, size: int) -> int:
    """Where the next whole head begins, or the end of the file."""
    file.seek(start)
    window = b""
    while chunk := file.read(CHUNK):
        window += chunk
        at = window.find(MAGIC)
        while at >= 0:
            if _read_head(window[at : at + HEAD.size]) is not None:
                return start + at
            at = window.find(MAGIC, at + 1)
        passed = max(0, len(window) - HEAD.size + 1)
        start, window = start + passed, window[passed:]
    return size


def _missing(path: Path, count: int) -> str:
    more = f" and the {count - 1:,} after it are" if count > 1 else " is"
    return f"{path}{more} missing"


def _batches(count: int, least: bool) -> str:
    told = f"{count:,} batches are" if count > 1 else "1 batch is"
    return f"at least {told}" if least else told


def _title(path: Path, found: _Found) -> Title | None:
    """The title that a whole record holds, None where it is a batch.

    Raises:
        RunError: it is of another format or version.
        WireError: it is neither.
    """
    try:
        header, _ = _parts(found.body or b"")
    except ProtocolError:
        if found.start:
            raise
        raise RunError(
            f"{path} was written by another version of tangram-rl: go on with that, or {ANOTHER}"
        ) from None
    if header["kind"] != Title.kind:
        return None
    if header.get("format") not in (FORMAT - 1, FORMAT):
        raise RunError(f"{path} is no segment of format {FORMAT}: {ANOTHER}")
    return read(Title, header)


def _batch(body: bytes, spec: EpisodeSpec) -> EpisodesArrived:
    """The batch that a whole record holds, checked as when it came; WireError if it is none."""
    header, data = _parts(body)
    entry, frames = read(Entry, {"owner": "", **header}), split_frames(data)
    batch = decode_from_worker(frames, spec)
    if not isinstance(batch, EpisodeBatch):
        raise WireError(f"a message of kind {batch.kind!r}")
    who = (entry.role, entry.index, entry.incarnation)
    return EpisodesArrived(*who, batch, frames, entry.process, entry.owner)


def _parts(body: bytes) -> tuple[Mapping[str, Any], bytes]:
    """The opened header, and the joined frames."""
    if len(body) < LENGTH.size:
        raise WireError("the record is empty")
    split = LENGTH.size + LENGTH.unpack_from(body)[0]
    return opened([body[LENGTH.size : split]]), body[split:]
