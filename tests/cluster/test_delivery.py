"""Delivery: what a real master acknowledged is in its replay exactly once, through kills."""

import json
import shutil
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.cluster.players import (
    Player,
    assert_exactly_once,
    finish,
    later_acknowledged,
    master,
    more_acknowledged,
    players,
    setup_of,
    until,
)

pytestmark = pytest.mark.cluster


def writing(folder: Path) -> bool:
    """Whether a checkpoint is being written."""
    return any((folder / "checkpoints").glob(".writing-*"))


def steps_without_answer(player: Player) -> int:
    """How many of 500 steps, a second or more, bring no acknowledgement."""
    before = player.acknowledged
    for step in range(500):
        player.step()
        if player.acknowledged > before:
            return step
    return 500


def delete(folder: Path, made: list[Player]) -> None:
    """The journal, then the run, and wait for acknowledgements of what was sent afterwards."""
    shutil.rmtree(folder / "journal")
    later_acknowledged(made)
    shutil.rmtree(folder.rename(folder.with_name("away")))  # at once
    until(made, lambda: steps_without_answer(made[0]) == 500)
    assert not folder.exists()  # not made again by accident
    folder.mkdir()
    # An acknowledgement that was on its way says nothing of the folder as it is now.
    later_acknowledged(made)


# In service.checkpoint_minutes, when each of its masters is killed.
LIVES = (
    (1000.0, "after all was deleted"),
    (1000.0, "after what was read from the journal"),
    (0.005, "while a checkpoint is written"),
)


def test_acknowledged_batches_survive_kills_of_the_master(folder: Path) -> None:
    with ExitStack() as stack:
        made: list[Player] = []
        for minutes, moment in LIVES:
            with master(folder, f"service.checkpoint_minutes={minutes}") as process:
                made = made or stack.enter_context(players(setup_of(folder), folder, folder))
                more_acknowledged(made, 5)
                if moment == "after all was deleted":
                    delete(folder, made)
                elif moment == "while a checkpoint is written":
                    until(made, lambda: writing(folder))
                process.kill()
                process.wait()
        with master(folder) as process:
            more_acknowledged(made, 5)
            finish(made, process)
        assert_exactly_once(folder, made)
        assert not list((folder / "checkpoints").glob(".writing-*"))
    result = json.loads((folder / "result.json").read_text())
    assert result["ended_by"] == "SIGTERM"
