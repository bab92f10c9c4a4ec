"""Reading the journal: finds the batches after a checkpoint, and reports those that are lost.

After a restart, the batches are inserted again in their first order. A damaged record does not
affect the records after it: the next one is found by its mark. The numbers of the records
show how many batches are missing. See `journal` for the format of a segment.
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
    MARK,
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
MAX_GAP = 2**32  # a record whose number is further ahead than this is taken for damaged
ANOTHER = "choose another run_dir, or delete its folder journal to go on without it"


def journal_run_id(folder: Path) -> str | None:
    """The run id in the journal, None if there is no journal; RunError for another format."""
    return next((title.run_id for _, title in _titles(folder)), None)


def check_journal(folder: Path, task: str) -> None:
    """Raise RunError if the journal is of another task or format."""
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
    """An iterable of the batches after a position in the journal, in their order.

    Each segment is synced before it is read, because the process that wrote it may have been killed
    before a sync, and the batches are reported to their workers as inserted.

    Attributes:
        number: number of the last batch that was found or is known to be lost.
        torn: where an unfinished record at the end of the newest segment begins; None if none.
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
        """Store the arguments; the journal is read during the iteration.

        Args:
            folder: of the segments.
            after: position of the checkpoint; None for the whole journal.
            run_id, task: those that the segments must have.
            spec: shapes and dtypes of the arrays.
            warn: called with one line for each loss, and for a record that was cut short.
        """
        self._folder, self._owner, self._spec, self._warn = folder, (run_id, task), spec, warn
        self.torn: int | None = None
        self._named, known = after is not None, after or Place()
        self._first, self.number = known.segment, known.number
        self._trouble: _Trouble | None = None

    def __iter__(self) -> Iterator[EpisodesArrived]:
        """Yield the batches; RunError for another run, task or format, or an unreadable disk."""
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
                f"the journal in {self._folder} cannot be read ({error.strerror}): repair the "
                f"disk, or {ANOTHER}"
            ) from None
        self._end()

    def _segment(self, path: Path) -> Iterator[EpisodesArrived]:
        self.torn = None
        for found in _scan(path):
            self.torn = found.start if found.torn else None  # the last part decides
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
        """Note a damaged part; the next intact record shows how many batches are missing."""
        last = self._trouble
        if last is None:
            self._trouble = _Trouble(where, number, torn, number > 0)
        else:
            torn = last.torn if last.torn and torn else ""
            self._trouble = _Trouble(last.where, max(last.number, number), torn, number > 0)

    def _reached(self, number: int, path: Path, start: int, another_life: bool) -> None:
        """Report the batches that are missing before an intact record; `number` came before it."""
        trouble, missing = self._trouble, number - self.number
        # A master process numbers its batches from the last one that it could read, so the numbers
        # before and after its title do not show all losses.
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
        unknown = "the batches in that part are lost, and their number is unknown"
        self._warn(trouble.torn or f"{trouble.where}: {known or unknown}")


class _Trouble(NamedTuple):
    """A damaged or missing part of the journal.

    Attributes:
        where: text for the warning.
        number: number of the last batch that is known to be in the part, 0 for none.
        torn: the warning to use if nothing was lost, because a kill left the part like this.
        whole: whether the part ends with an intact head, so that it has no batch after `number`.
    """

    where: str
    number: int
    torn: str
    whole: bool


class _Found(NamedTuple):
    """A part of a segment: a record, or damaged bytes.

    Attributes:
        start, end: offsets in bytes.
        number: number of the record, 0 if the head is damaged or the end is missing.
        body: of the record; None if it is damaged.
        torn: whether the part is incomplete, as after a kill.
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
            # Read no further than the file goes: a forged head could ask for 4 GiB of memory.
            body = file.read(length) if end <= size else b""
            if head is not None and len(body) == length and zlib.crc32(body) == checksum:
                yield _Found(start, end, number, body, torn=False)
            else:
                told, end = end, min(end if head else size, _next_head(file, start + 1, size))
                yield _Found(start, end, number if told == end else 0, None, end == size < told)
            start = end


def _read_head(head: bytes) -> tuple[int, int, int] | None:
    """Length, number and checksum of a body; None if the head is damaged."""
    if len(head) < HEAD.size:
        return None
    magic, length, number, checksum, own = HEAD.unpack(head)
    whole = magic == MAGIC and own == zlib.crc32(head[: -CRC.size])
    return (length, number, checksum) if whole else None


def _next_head(file: BinaryIO, start: int, size: int) -> int:
    """Offset of the next head, damaged or not, or the size of the file."""
    file.seek(start)
    window = b""
    while chunk := file.read(CHUNK):
        window += chunk
        if (at := window.find(MARK, HEAD.size)) >= 0:
            return start + at - HEAD.size
        passed = max(0, len(window) - HEAD.size - len(MARK) + 1)
        start, window = start + passed, window[passed:]
    return size


def _missing(path: Path, count: int) -> str:
    more = f" and the {count - 1:,} after it are" if count > 1 else " is"
    return f"{path}{more} missing"


def _batches(count: int, least: bool) -> str:
    told = f"{count:,} batches are" if count > 1 else "1 batch is"
    return f"at least {told}" if least else told


def _title(path: Path, found: _Found) -> Title | None:
    """The title in an intact record, None if the record is a batch.

    Raises:
        RunError: the title is of another format or version.
        WireError: the record is neither a title nor a batch.
    """
    try:
        header, _ = _parts(found.body or b"")
    except ProtocolError:
        if found.start or found.body is None:
            raise
        raise RunError(
            f"{path} was written by another version of tangram-rl: go on with that, or {ANOTHER}"
        ) from None
    if header["kind"] != Title.kind:
        return None
    if header.get("format") != FORMAT:
        raise RunError(f"{path} is not a segment of format {FORMAT}: {ANOTHER}")
    return read(Title, header)


def _batch(body: bytes, spec: EpisodeSpec) -> EpisodesArrived:
    """The batch in an intact record, checked as on arrival; WireError if it is not a batch."""
    header, data = _parts(body)
    entry, frames = read(Entry, header), split_frames(data)
    batch = decode_from_worker(frames, spec)
    if not isinstance(batch, EpisodeBatch):
        raise WireError(f"a message of kind {batch.kind!r}")
    who = (entry.role, entry.index, entry.incarnation)
    return EpisodesArrived(*who, batch, frames, entry.process, entry.owner)


def _parts(body: bytes) -> tuple[Mapping[str, Any], bytes]:
    """The decoded header and the joined frames of a body."""
    begin = len(MARK) + LENGTH.size
    if len(body) < begin or not body.startswith(MARK):
        raise ProtocolError("the record has no mark")
    split = begin + LENGTH.unpack_from(body, len(MARK))[0]
    return opened([body[begin:split]]), body[split:]
