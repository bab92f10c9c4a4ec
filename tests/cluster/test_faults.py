"""Faults of the machine and the network, against real masters and workers."""

import json
import os
import signal
import time
from pathlib import Path

import pytest
import zmq

from tangram_lab.benchmarks.trials.proxy import DOWN, UP, Proxy
from tests.cluster.players import (
    LIMIT_S,
    TCP,
    Player,
    assert_exactly_once,
    finish,
    master,
    more_acknowledged,
    players,
    setup_of,
    until,
)
from tests.cluster.processes import all_ended, pids_of, started
from worker.status import ask_status

pytestmark = pytest.mark.cluster


def port_of(folder: Path) -> int:
    content = json.loads((folder / "connection.json").read_text())
    return int(content["endpoint"].rpartition(":")[2])


def test_a_network_that_swallows_everything_for_a_while(folder: Path) -> None:
    """In either direction. One player is behind the proxy, one beside it."""
    with (
        master(folder, *TCP) as process,
        Proxy(port_of(folder)) as proxy,
        players(setup_of(folder), f"tcp://127.0.0.1:{proxy.port}", beside=folder) as made,
    ):
        more_acknowledged(made, 5)
        for direction in (UP, DOWN):
            swallowed(proxy, direction, made)
        assert made[1].client.counters["reconnects"] == 0
        finish(made, process)
    assert_exactly_once(folder, made)


def swallowed(proxy: Proxy, direction: str, made: list[Player]) -> None:
    """Cut the first player off until it has connected anew, while the second goes on."""
    behind, beside = made
    reconnects, goal = behind.client.counters["reconnects"], beside.acknowledged + 20
    proxy.cut(direction)
    until(
        made,
        lambda: behind.client.counters["reconnects"] > reconnects and beside.acknowledged >= goal,
    )
    stuck = behind.acknowledged
    proxy.cut()
    until(made, lambda: behind.acknowledged >= stuck + 5)


def test_who_is_frozen_harms_nobody_and_comes_back(folder: Path) -> None:
    """A worker for longer than the master's patience, while the other goes on; then the master."""
    with (
        master(folder, "service.silence_seconds=3") as process,
        players(setup_of(folder), folder, folder) as made,
    ):
        frozen, other = made
        more_acknowledged(made, 3)
        with zmq.Context() as context:

            def count() -> float:
                return ask_status(str(folder), context).numbers["players"]

            until(made, lambda: count() == 2.0)
            until([other], lambda: count() == 1.0)
        more_acknowledged([other], 5)
        more_acknowledged(made, 5)
        assert frozen.client.counters["reconnects"] == 0  # it was greeted anew on its connection
        process.send_signal(signal.SIGSTOP)
        until(made, lambda: all(player.client.counters["reconnects"] for player in made))
        process.send_signal(signal.SIGCONT)
        more_acknowledged(made, 5)
        finish(made, process)
    assert_exactly_once(folder, made)


@pytest.mark.parametrize(
    "command", ["tangram-train", pytest.param("tangram-bench", marks=pytest.mark.check)]
)
def test_no_process_is_left_of_a_training_whose_parent_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """The launcher of its processes, or the measurement that started the launcher."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where a measurement trains
    itself = command == "tangram-train"
    quick = (f"run_dir={tmp_path / 'run'}", "sim=kinematic", "net=mlp", "workers=2")
    # A measurement begins with one worker, and a launcher below it.
    with started(command, *(quick if itself else ["train"]), cwd=tmp_path) as process:
        end = time.monotonic() + LIMIT_S
        while len(pids_of(tmp_path)) < 4 + itself and time.monotonic() < end:
            time.sleep(0.05)
        children = [pid for pid in pids_of(tmp_path) if pid != process.pid]
        os.kill(process.pid, signal.SIGKILL)
        assert len(children) == 4
        assert all_ended(children)
