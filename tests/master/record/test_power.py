"""Power cuts at any moment: what was acknowledged is there, and what has its name is whole."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from random import Random

import numpy as np
import pytest

from master.record.journal import Journal, Place
from master.record.recovery import Reader
from master.record.rundir import RunFolder
from tangram_core.store.checkpoints import list_checkpoints, load_checkpoint, save_checkpoint
from tangram_core.store.files import write_whole
from tests.master.builders import arrival, small_setup
from tests.master.record.power import Machine, PowerCutError

# A process without power closes nothing.
UNCLOSED = "ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning"
pytestmark = [pytest.mark.fast, pytest.mark.filterwarnings(UNCLOSED)]

MADE = small_setup()
DIGEST = MADE.task_digest()
SPEC = MADE.spec
BATCHES = [arrival(MADE, number, count=1) for number in range(1, 6)]
CHANCES = 12

Work = Callable[[Path, list[int]], None]


def power_cuts(
    place: Path, patch: pytest.MonkeyPatch, work: Work, kill: bool = False
) -> Iterator[tuple[Machine, list[int]]]:
    """Work that is cut before each of its syncs, and at its end; and what it said was done."""
    for cut_at in count(1):
        for chance in range(CHANCES):
            machine, done = Machine(place / f"{cut_at}-{chance}", patch), list[int]()
            machine.cut_at = cut_at
            with suppress(PowerCutError):
                work(machine.folder, done)
            ended, machine.cut_at = machine.syncs < cut_at, 0
            if not kill:
                machine.restarted(Random(chance))
            yield machine, done
            machine.close()
        if ended:
            return


def test_a_file_is_the_old_or_the_new_one_and_stays_the_one_that_was_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(folder: Path, done: list[int]) -> None:
        for number in (1, 2):
            write_whole(folder / "some" / "new" / "result.json", b"%d" % number)
            done.append(number)

    for machine, done in power_cuts(tmp_path, monkeypatch, work):
        path = machine.folder / "some" / "new" / "result.json"
        found = int(path.read_bytes()) if path.exists() else 0
        assert max(done, default=0) <= found <= 2


def begin(folder: Path) -> RunFolder:
    """A run folder in folders that are not there yet."""
    run = RunFolder(folder / "runs" / "run")
    run.prepare("auto")
    return run


def read(run: RunFolder, first: Place | None = None) -> tuple[Reader, list[int]]:
    reader = Reader(run.journal, first, "run", DIGEST, SPEC, lambda _: None)
    return reader, [one.sequence for one in reader]


def journal_batches(folder: Path, done: list[int]) -> None:
    """Two lives, and a checkpoint's new segment in each."""
    run, number = begin(folder), 0
    for life in (BATCHES[:3], BATCHES[3:]):
        kept = Journal(run.journal, "run", DIGEST, 0.0, Place(number=number))
        try:
            for batch in life:
                kept.append(batch)
                done.append(batch.sequence)
                if batch.sequence in (2, 4):
                    kept.rotate()
            number = kept.number
        finally:
            kept._drop()


def test_what_was_journalled_is_found_after_a_power_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for machine, done in power_cuts(tmp_path, monkeypatch, journal_batches):
        _, found = read(begin(machine.folder))
        assert found in (done, [*done, len(done) + 1])


def test_what_a_restart_has_read_is_found_after_a_power_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed between write and sync: the next life tells the sender that it was inserted."""
    for machine, _ in power_cuts(tmp_path, monkeypatch, journal_batches, kill=True):
        reader, found = read(begin(machine.folder))
        machine.restarted(Random(machine.syncs))
        _, again = read(begin(machine.folder))
        assert again == found
        assert len(found) == reader.number


def test_a_segment_that_is_named_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the checkpoint that names it: a missing one would be told as a loss."""

    def work(folder: Path, done: list[int]) -> None:
        kept = Journal(begin(folder).journal, "run", DIGEST, 1000.0)
        try:
            kept.append(BATCHES[0])
            done.append(kept.rotate().segment)
        finally:
            kept._drop()

    for machine, done in power_cuts(tmp_path, monkeypatch, work):
        for segment in done:
            run = begin(machine.folder)
            reader = Reader(run.journal, Place(segment, 1), "run", DIGEST, SPEC, pytest.fail)
            assert list(reader) == []


def test_a_checkpoint_that_has_its_name_is_whole_and_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(folder: Path, done: list[int]) -> None:
        run = begin(folder)
        for number in (1, 2, 3):
            arrays = {"replay": {"tags": np.full(9, number)}}
            save_checkpoint(run.checkpoints, number, arrays, {"number": number}, keep=2)
            done.append(number)

    for machine, done in power_cuts(tmp_path, monkeypatch, work):
        found = list_checkpoints(begin(machine.folder).checkpoints)[-2:]
        newest = 0
        for path in found:
            content = load_checkpoint(path)
            newest = content.counters["number"]
            assert set(content.arrays["replay"]["tags"]) == {newest}
        assert newest >= max(done, default=0)
