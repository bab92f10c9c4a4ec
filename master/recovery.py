"""Reading a journal back: what was acknowledged after the checkpoint that a run goes on from."""

import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from master.arrivals import EpisodesArrived
from master.journal import FORMAT, HEAD, LENGTH, segment_path, segments
from tangram_agent.decoding import MAX_INDEX
from tangram_agent.frames import MAX_HEADER, MAX_ID, Fields, ProtocolError, unpack_header
from tangram_agent.payloads import MAX_BATCH_BYTES, EpisodeSpec, decode_episodes
from tangram_agent.wire import ROLES
from tangram_sim.errors import RunError, WireError

MAX_BODY = MAX_BATCH_BYTES + MAX_HEADER + LENGTH.size
MAX_FORMAT = 2**31
ANOTHER = "choose another run_dir, or delete its folder journal to go on without it"


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
    found = segments(folder)
    for number in range(first, max(found, default=0) + 1):
        if number not in found:
            path = segment_path(folder, number)
            warn(f"warning: {path} is missing: the batches that it held are lost")
            continue
        yield from _segment(found[number], run_id, task, spec, warn)


def _segment(
    path: Path, run_id: str, task: str, spec: EpisodeSpec, warn: Callable[[str], None]
) -> Iterator[EpisodesArrived]:
    records = _records(path, warn)
    for header, _ in records:
        if _title(path, header) != (run_id, task):
            raise _of_another(path)
        break
    for header, arrays in records:
        try:
            yield _batch(header, arrays, spec)
        except WireError as error:
            raise _unreadable(path, error) from None


def _records(path: Path, warn: Callable[[str], None]) -> Iterator[tuple[Fields, bytes]]:
    """Header and arrays of each record, up to one that is not whole."""
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
        f"warning: {path} is damaged at byte {start:,}: the {size - start:,} bytes from there on "
        "are lost, with the batches in them"
    )


def _parts(path: Path, body: bytes) -> tuple[Fields, bytes]:
    (length,) = LENGTH.unpack_from(body)
    split = LENGTH.size + length
    try:
        return unpack_header(body[LENGTH.size : split]), body[split:]
    except ProtocolError:
        raise RunError(
            f"{path} was written by another version of tangram-rl: go on with that, or {ANOTHER}"
        ) from None
    except WireError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: WireError) -> RunError:
    return RunError(f"{path} holds what cannot be read ({error}): {ANOTHER}")


def _title(path: Path, fields: Fields) -> tuple[str, str]:
    """Run id and task of a segment."""
    try:
        if fields.kind != "segment" or fields.integer("format", 0, MAX_FORMAT) != FORMAT:
            raise RunError(f"{path} is no segment of format {FORMAT}: {ANOTHER}")
        title = fields.text("run_id", MAX_ID), fields.text("task", MAX_ID)
        fields.end()
    except WireError as error:
        raise RunError(f"{path} is no journal ({error}): {ANOTHER}") from None
    return title


def _batch(fields: Fields, data: bytes, spec: EpisodeSpec) -> EpisodesArrived:
    if fields.kind != "batch":
        raise WireError(f"a record of kind {fields.kind!r}")
    key = (
        fields.text("role", choices=ROLES),
        fields.integer("index", 0, MAX_INDEX),
        fields.integer("incarnation", 1),
        fields.integer("sequence", 1),
        fields.integer("weights_version", -1),
    )
    count = fields.integer("count", 1, spec.max_count)
    fields.end()
    frames, start = [], 0
    for column in spec.columns(count):
        frames.append(data[start : start + column.size])
        start += column.size
    if start != len(data):
        raise WireError(f"{len(data)} bytes of arrays, there must be {start}")
    return EpisodesArrived(*key, decode_episodes(frames, count, spec))
