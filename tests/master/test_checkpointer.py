"""Batches and checkpoints on their way to the disk, and a disk that is full."""

import errno
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from master.checkpointer import MAKE_ROOM, restore_run
from master.journal import JournalError, segments
from master.trainer import Trainer
from tangram_agent import checkpoints as checkpoints_module
from tangram_agent.checkpoints import DiskError, list_checkpoints
from tangram_agent.process import Every
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
        self.folder, self.checkpointer = folder, loop(folder, MADE, FakeHub(MADE)).checkpointer
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
    assert stage.told == ["the journal cannot be written"]
