"""Batches and checkpoints on their way to the disk, and a disk that is full."""

import errno
import json
import logging
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from master.checkpointer import AT_ONCE, MAKE_ROOM, WAIT, restore_run
from master.learn.trainer import Trainer
from master.record import journal as journal_module
from master.record.journal import JournalError, segments
from master.record.recovery import Reader
from master.record.rundir import LEASE, RunFolder
from tangram_core.errors import ConfigError, FailedError, RunError
from tangram_core.run.process import Every
from tangram_core.store import checkpoints as checkpoints_module
from tangram_core.store.checkpoints import DiskError, list_checkpoints
from tests.master.builders import Disk, FakeHub, arrival, loop, small_setup

pytestmark = pytest.mark.fast

MADE = small_setup()
ROOM = 10**9


class Stage:
    """A checkpointer, what it told, and a disk that can be full."""

    def __init__(
        self, folder: Path, patch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        caplog.set_level(logging.INFO)
        self.disk, self._caplog = Disk(patch), caplog
        self.folder = folder / "run"
        self.folder.mkdir()
        self.checkpointer = loop(self.folder, MADE, FakeHub(MADE)).checkpointer
        self.checkpointer._retry = Every(0.0)
        self._write = checkpoints_module._write
        patch.setattr(checkpoints_module, "_write", self._guarded)

    @property
    def told(self) -> list[str]:
        return self._caplog.messages

    def keep(self, number: int) -> bool:
        return self.checkpointer.keep(arrival(MADE, number))

    def _guarded(self, *arguments: Any) -> None:
        if not self.disk.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        self._write(*arguments)


@pytest.fixture
def stage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> Stage:
    return Stage(tmp_path, monkeypatch, caplog)


def test_a_full_disk_is_told_once_and_the_batch_is_kept_when_there_is_room(stage: Stage) -> None:
    stage.disk.room = 0
    assert [stage.keep(1) for _ in range(3)] == [False] * 3
    where = stage.folder / "journal"
    assert stage.told == [
        f"the journal in {where} cannot be written (No space left on device): {MAKE_ROOM}"
    ]
    stage.disk.room = ROOM
    assert stage.keep(1)
    assert stage.told[1:] == ["the journal can be written again: batches are taken in"]
    assert stage.keep(2)
    stage.disk.room = 0
    assert not stage.keep(3)
    assert len(stage.told) == 3


def test_a_disk_that_does_not_take_a_checkpoint_ends_nothing(stage: Stage) -> None:
    assert stage.keep(1)
    first = stage.checkpointer.save()
    title = segments(stage.folder / "journal")[2].stat().st_size
    assert stage.keep(2)
    stage.disk.room = 0
    stage.checkpointer._checkpoint = Every(0.0)
    stage.checkpointer.tick()
    assert len(stage.told) == 1
    assert "cannot be written (No space left on device)" in stage.told[0]
    assert list((stage.folder / "checkpoints").iterdir()) == [first]
    stage.disk.room = title  # and for nothing more
    with pytest.raises(DiskError, match="make room there"):
        stage.checkpointer.save()
    assert list((stage.folder / "checkpoints").iterdir()) == [first]
    stage.disk.room = ROOM
    stage.checkpointer.tick()
    assert len(list_checkpoints(stage.folder / "checkpoints")) == 2


def test_a_disk_whose_files_cannot_be_looked_at_is_waited_for(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert stage.keep(1)
    stage.checkpointer.save()
    stage.checkpointer._look = Every(0.0)
    with monkeypatch.context() as failing:
        failing.setattr(Path, "is_dir", fails)
        assert not stage.keep(2)
        stage.checkpointer.tick()
    assert stage.told == [f"[Errno 5] Input/output error: {MAKE_ROOM}"]
    assert stage.keep(2)


def fails(_: Path) -> bool:
    raise OSError(errno.EIO, "Input/output error")


@pytest.mark.parametrize(("takes_s", "rests_s"), [(10.0, 90.0), (1000.0, 3600.0)])
def test_a_slow_disk_takes_a_tenth_of_the_time_for_an_hour(
    stage: Stage, monkeypatch: pytest.MonkeyPatch, takes_s: float, rests_s: float
) -> None:
    now, saved = [time.monotonic()], list[float]()
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(time, "clock_gettime", lambda _: now[0])

    def save() -> None:
        now[0] += takes_s
        saved.append(now[0])

    monkeypatch.setattr(stage.checkpointer, "save", save)
    stage.checkpointer._checkpoint = Every(1.0)
    begun = now[0]
    for _ in range(int(rests_s) + 2):
        now[0] += 1.0
        stage.checkpointer.tick()
    assert np.round(np.subtract(saved, begun)).tolist() == [
        1.0 + takes_s,
        1.0 + 2.0 * takes_s + rests_s,
    ]


def test_only_what_is_finite_is_saved(stage: Stage) -> None:
    """The last good state is, when the weights were spoilt after the last look at them."""
    trainer = stage.checkpointer._guard.trainer
    with torch.no_grad():
        next(trainer.learner.actor.parameters()).fill_(float("nan"))
    stage.checkpointer.save()
    saved = Trainer(MADE, 0, "cpu", 64)
    assert restore_run(stage.folder / "checkpoints", saved) is not None
    for name, array in saved.learner.state().items():
        assert np.isfinite(array).all(), name


def test_segments_live_as_long_as_a_checkpoint_needs_them(stage: Stage) -> None:
    """Two checkpoints are kept: the older one needs what came between it and the newer one."""
    left = []
    for number in range(1, 5):
        assert stage.keep(number)
        stage.checkpointer.save()
        left.append(list(segments(stage.folder / "journal")))
    assert left == [[2], [2, 3], [3, 4], [4, 5]]


def test_a_journal_that_cannot_be_synced_is_told(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert stage.keep(1)

    def fail() -> None:
        raise JournalError("the journal cannot be written")

    monkeypatch.setattr(stage.checkpointer._journal, "tick", fail)
    stage.checkpointer.tick()
    assert stage.told == [f"the journal cannot be written: {MAKE_ROOM}"]


def inserted(stage: Stage) -> tuple[int, list[int]]:
    """Where a restart would begin, and the batches that it would insert then."""
    found = restore_run(stage.folder / "checkpoints", Trainer(MADE, 0, "cpu", 64))
    place, spec = found.place if found else None, MADE.spec
    journal = stage.folder / "journal"
    batches = Reader(journal, place, "run", MADE.task_digest(), spec, pytest.fail)
    return place.number if place else 0, [one.sequence for one in batches]


def emptied(folder: Path) -> None:
    for path in folder.iterdir():
        if path.name != ".lock":
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def made_anew(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()


def copied(folder: Path) -> None:
    shutil.copytree(folder, folder.with_name("copy"))
    shutil.rmtree(folder)
    folder.with_name("copy").rename(folder)


LOST: dict[str, tuple[Callable[[Path], object], str]] = {
    "a segment": (
        lambda folder: segments(folder / "journal")[2].unlink(),
        "has lost its newest segment of the journal",
    ),
    "the journal": (
        lambda folder: shutil.rmtree(folder / "journal"),
        "has lost its newest segment of the journal",
    ),
    "the checkpoint": (
        lambda folder: shutil.rmtree(folder / "checkpoints"),
        "has lost its newest checkpoint",
    ),
    "all but the lock": (emptied, "has lost its newest segment of the journal"),
    "the lock": (lambda folder: (folder / ".lock").unlink(), "was made anew"),
    "the folder, made anew": (made_anew, "was made anew"),
}


@pytest.mark.parametrize("lost", LOST)
@pytest.mark.parametrize("looks", ["at the next batch", "at the next sync"])
def test_what_is_deleted_under_a_master_is_told_and_written_anew_at_once(
    stage: Stage, lost: str, looks: str
) -> None:
    """Acknowledgements went on into files without names, and a second master began beside it."""
    assert stage.keep(1)
    stage.checkpointer.save()
    assert stage.keep(2)
    lose, told = LOST[lost]
    lose(stage.folder)
    if looks == "at the next batch":
        assert stage.keep(3)
        after = (2, [3])
    else:
        stage.checkpointer._look = Every(0.0)
        stage.checkpointer.tick()
        after = (2, [])
    assert stage.told == [f"run_dir {stage.folder} {told}: {AT_ONCE}"]
    assert inserted(stage) == after
    with pytest.raises(ConfigError, match="in use by another process"):
        RunFolder(stage.folder).lock()
    assert (stage.folder / "config.yaml").exists()
    assert stage.keep(4)
    assert len(stage.told) == 1
    assert inserted(stage) == (2, [*after[1], 4])  # one checkpoint was enough


GONE: dict[str, tuple[Callable[[Path], object], str]] = {
    "deleted": (shutil.rmtree, "is gone"),
    "moved": (lambda folder: folder.rename(folder.with_name("away")), "is gone"),
    "another one": (copied, "was replaced by a folder with another run"),
}


@pytest.mark.parametrize("gone", GONE)
def test_nothing_is_acknowledged_while_the_run_folder_is_gone(stage: Stage, gone: str) -> None:
    assert stage.keep(1)
    stage.checkpointer.save()
    lose, told = GONE[gone]
    lose(stage.folder)
    there = stage.folder.exists()
    stage.checkpointer._look = stage.checkpointer._checkpoint = Every(0.0)
    for _ in range(3):
        assert not stage.keep(2)
        stage.checkpointer.tick()
    with pytest.raises(RunError, match=f"^run_dir {stage.folder} {told}$"):
        stage.checkpointer.save()
    back = "put it back, or make an empty folder there"
    assert stage.told == [f"run_dir {stage.folder} {told}: {back}; {WAIT}"]
    assert stage.checkpointer.failing
    assert stage.checkpointer.homeless
    assert stage.folder.exists() == there  # not made again by accident
    if there:
        shutil.rmtree(stage.folder)
    away = stage.folder.with_name("away")
    away.rename(stage.folder) if away.exists() else stage.folder.mkdir()
    assert stage.keep(2)
    assert not stage.checkpointer.failing
    assert not stage.checkpointer.homeless
    assert stage.told[-1] == "the journal can be written again: batches are taken in"
    assert len(stage.told) == (2 if gone == "moved" else 3)
    assert inserted(stage) == (1, [2])


def test_a_master_whose_run_another_machine_has_taken_over_ends(stage: Stage) -> None:
    """It acknowledges nothing, and leaves the other's address alone."""
    run = stage.checkpointer._claim.run
    run.connection.write_text("theirs")
    (stage.folder / LEASE).write_text(json.dumps({"host": "far", "id": "theirs"}))
    stage.checkpointer._claim._lease._due = stage.checkpointer._look = Every(0.0)
    for act in (partial(stage.keep, 1), stage.checkpointer.tick, stage.checkpointer.save):
        with pytest.raises(FailedError, match="is lost: a process on far has taken it over") as end:
            act()
        assert end.value.status == 1  # the launcher starts it again, and it waits
    run.remove_connection()
    assert run.connection.read_text() == "theirs"


@pytest.mark.parametrize("hung", ["append", "rotate", "sync_folder"])
def test_who_hung_for_longer_than_a_lease_lasts_writes_and_acknowledges_nothing(
    stage: Stage, monkeypatch: pytest.MonkeyPatch, hung: str
) -> None:
    """Another machine has read what is on the disk, and goes on from there."""
    checkpointer = stage.checkpointer
    checkpointer._claim._lease._due = Every(0.0)
    place: object = journal_module if hung == "sync_folder" else checkpointer._journal
    real = getattr(place, hung)

    def hangs(*arguments: object) -> object:
        done = real(*arguments)
        (stage.folder / LEASE).write_text(json.dumps({"host": "far", "id": "theirs"}))
        return done

    monkeypatch.setattr(place, hung, hangs)
    with pytest.raises(FailedError, match="is lost: a process on far has taken it over"):
        checkpointer.save() if hung == "rotate" else stage.keep(1)
    assert not list_checkpoints(stage.folder / "checkpoints")
    [segment] = segments(stage.folder / "journal").values()
    assert (segment.stat().st_size == 0) == (hung == "sync_folder")


def test_a_second_master_in_a_folder_that_was_made_anew_keeps_it(stage: Stage) -> None:
    assert stage.keep(1)
    made_anew(stage.folder)
    with RunFolder(stage.folder).lock():
        assert not stage.keep(2)
        assert "cannot be locked again (another process uses it)" in stage.told[0]
        assert {path.name for path in stage.folder.iterdir()} == {".lock", LEASE}
    assert stage.keep(2)


def test_a_checkpoint_that_is_due_at_once_stays_so_until_it_is_written(stage: Stage) -> None:
    assert stage.keep(1)
    shutil.rmtree(stage.folder / "journal")
    stage.disk.room = 0
    for _ in range(2):
        assert not stage.keep(2)
    assert len(stage.told) == 2  # what is gone, and that the disk is full
    stage.disk.room = ROOM
    assert stage.keep(2)
    assert inserted(stage) == (1, [2])


def test_after_a_sync_that_failed_nothing_depends_on_what_it_was_to_sync(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next sync of the same file may succeed without what this one has lost."""

    def fail(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    assert stage.keep(1)
    stage.checkpointer._journal._sync = Every(0.0)
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", fail)
        stage.checkpointer.tick()
    assert "cannot be written (Input/output error)" in stage.told[0]
    segments(stage.folder / "journal")[1].unlink()
    assert stage.keep(2)
    assert inserted(stage) == (1, [2])
