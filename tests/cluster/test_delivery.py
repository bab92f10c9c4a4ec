"""Delivery: what a real master acknowledged is in its replay exactly once, through kills."""

import json
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.cluster.players import (
    Player,
    assert_exactly_once,
    finish,
    master,
    more_acknowledged,
    setup_of,
    until,
)

pytestmark = pytest.mark.cluster


def writing(folder: Path) -> bool:
    """Whether a checkpoint is being written."""
    return any((folder / "checkpoints").glob(".writing-*"))


# In service.checkpoint_minutes, when each of its masters is killed.
LIVES = (
    (1000.0, "before the first checkpoint"),
    (1000.0, "after what was read from the journal"),
    (0.005, "while a checkpoint is written"),
)


def test_acknowledged_batches_survive_kills_of_the_master(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    players: list[Player] = []
    with ExitStack() as stack:
        for minutes, moment in LIVES:
            with master(folder, f"service.checkpoint_minutes={minutes}") as process:
                if not players:
                    players += [Player(folder, i, setup_of(folder)) for i in range(2)]
                    for player in players:
                        stack.enter_context(player.client)
                        player.client.join()
                more_acknowledged(players, 5)
                if moment == "while a checkpoint is written":
                    until(players, lambda: writing(folder))
                process.kill()
                process.wait()
        with master(folder) as process:
            more_acknowledged(players, 5)
            finish(players, process)
        assert_exactly_once(folder, players)
        assert not list((folder / "checkpoints").glob(".writing-*"))
    result = json.loads((folder / "result.json").read_text())
    assert result["ended_by"] == "SIGTERM"
