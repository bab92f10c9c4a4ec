"""Faults of the machine and the network, against real masters and workers."""

import json
import os
import shutil
import signal
import socket
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
import zmq

from tangram_agent.checkpoints import list_checkpoints, load_checkpoint
from tangram_agent.messages import WORKER_COLUMNS
from tangram_lab.benchmarks.proxy import DOWN, UP, Proxy
from tests.cluster.players import (
    LIMIT_S,
    MASTER,
    TCP,
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
from tests.cluster.processes import BIN, all_ended, pids_of, started, wait_for_file
from worker.status import ask_status

EVALUATOR, INDEX, INCARNATION, EPISODES = map(
    WORKER_COLUMNS.index, ("evaluator", "index", "incarnation", "episodes")
)

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


def test_what_is_deleted_under_a_master_loses_nothing(folder: Path) -> None:
    """The journal, then the run; kill -9 once a batch that was sent later is acknowledged."""
    with ExitStack() as stack:
        with master(folder, "service.checkpoint_minutes=1000") as process:
            made = stack.enter_context(players(setup_of(folder), folder, folder))
            more_acknowledged(made, 5)
            shutil.rmtree(folder / "journal")
            later_acknowledged(made)
            shutil.rmtree(folder)
            until(made, lambda: steps_without_answer(made[0]) == 500)
            assert not folder.exists()  # not made again by accident
            folder.mkdir()
            # An acknowledgement that was on its way says nothing of the folder as it is now.
            later_acknowledged(made)
            process.kill()
            process.wait()
        with master(folder) as process:
            more_acknowledged(made, 5)
            finish(made, process)
    assert_exactly_once(folder, made)


def can_mount() -> bool:
    """Whether this user may have a file system of his own."""
    if shutil.which("unshare") is None:
        return False
    command = ["unshare", "-Urm", "sh", "-c", "mount -t tmpfs -o size=1m none /mnt"]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@pytest.mark.skipif(not can_mount(), reason="this machine lets nobody mount a small disk")
def test_a_full_disk_stops_the_acknowledgements_and_nothing_is_lost(tmp_path: Path) -> None:
    """The run lies on a disk of 40 MB, in a namespace of its own, that something else fills up."""
    disk, log, kept = tmp_path / "disk", tmp_path / "log", tmp_path / "kept"
    disk.mkdir()
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    settings = [*MASTER, *TCP, f"service.port={port}", "service.checkpoint_minutes=0.05"]
    words = " ".join(f"'{text}'" for text in [f"run_dir={disk / 'run'}", *settings])
    script = (
        f"mount -t tmpfs -o size=40m none {disk} && {{\n"
        f"{BIN / 'tangram-master'} {words} > {log} 2>&1 & echo $! > {tmp_path / 'pid'}\n"
        f"wait $!; status=$?; cp -r {disk / 'run'} {kept}; exit $status; }}"
    )
    process = subprocess.Popen(["unshare", "-Urm", "sh", "-c", script], start_new_session=True)
    try:
        inside = Path(f"/proc/{process.pid}/root{disk}")  # the disk as the master sees it
        wait_for_file(inside / "run" / "connection.json", process)
        setup = setup_of(inside / "run")
        with players(setup, f"tcp://127.0.0.1:{port}") as made:
            more_acknowledged(made, 5)
            fill(inside / "ballast")
            until(made, lambda: "nothing is acknowledged" in log.read_text())
            (player,) = made
            # Some were on their way; then the window is full, and it waits with what it played.
            until(made, lambda: steps_without_answer(player) == 500)
            assert player.client.window_free == 0
            assert process.poll() is None
            (inside / "ballast").unlink()
            more_acknowledged(made, 5)
            assert "batches are taken in" in log.read_text()
            os.kill(int((tmp_path / "pid").read_text()), signal.SIGTERM)
            until(made, lambda: process.poll() is not None)
            assert process.returncode == 0, log.read_text()
        assert_exactly_once(kept, made)
    finally:
        with suppress(ProcessLookupError):  # it has ended
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def steps_without_answer(player: Player) -> int:
    """How many of 500 steps, a second or more, bring no acknowledgement."""
    before = player.acknowledged
    for step in range(500):
        player.step()
        if player.acknowledged > before:
            return step
    return 500


def fill(path: Path) -> None:
    """Write until the disk is full to the last byte."""
    with path.open("wb", buffering=0) as file:
        for size in (2**20, 2**12, 1):
            try:
                while file.write(b"\0" * size):
                    pass
            except OSError:
                continue


def test_a_worker_that_is_killed_while_it_plays_comes_back(tmp_path: Path) -> None:
    """Real workers with the engine; episodes of theirs that never arrived are all that is lost."""
    folder = tmp_path / "run"
    settings = (
        *("workers=2", "agent.learning_starts=100", "agent.replay_capacity=2000000"),
        *("net=mlp", "service.eval_episodes=4", "service.eval_seconds=1000"),
        *("agent.updates_per_transition=0.02", "max_updates=100000"),
    )
    with (
        zmq.Context() as context,
        started("tangram-train", f"run_dir={folder}", *settings, cwd=tmp_path) as process,
    ):
        wait_for_file(folder / "connection.json", process)

        def plays(incarnation: int) -> bool:
            rows = ask_status(str(folder), context, 5.0).workers
            players = {int(r[INDEX]): r for r in rows if not r[EVALUATOR] and r[EPISODES]}
            return len(players) == 2 and players[1][INCARNATION] == incarnation

        for incarnation in (1, 2):
            until([], lambda life=incarnation: plays(life))
            if incarnation == 1:
                (pid,) = (p for p in pids_of(folder) if b"index=1" in command_line(p))
                os.kill(pid, signal.SIGKILL)
        process.terminate()
        assert process.wait(LIMIT_S) == 0
    content = load_checkpoint(list_checkpoints(folder / "checkpoints")[-1])
    copies = 1 + sum(twin.copies for twin in setup_of(folder).agent.hindsight)
    assert content.counters["episodes"] * copies == len(content.arrays["replay"]["reward"])
    assert content.counters["hub"]["player/1"]["incarnation"] == 2
    assert pids_of(folder) == []


def command_line(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()


@pytest.mark.parametrize(
    "command", ["tangram-train", pytest.param("tangram-bench", marks=pytest.mark.check)]
)
def test_no_process_is_left_of_a_training_whose_parent_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """The launcher of its processes, or the trial that started the launcher."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where a trial trains
    itself = command == "tangram-train"
    quick = (f"run_dir={tmp_path / 'run'}", "sim=kinematic", "net=mlp", "workers=2")
    with started(command, *(quick if itself else ["soak"]), cwd=tmp_path) as process:
        end = time.monotonic() + LIMIT_S
        while len(pids_of(tmp_path)) < 5 and time.monotonic() < end:
            time.sleep(0.05)
        children = [pid for pid in pids_of(tmp_path) if pid != process.pid]
        os.kill(process.pid, signal.SIGKILL)
        assert len(children) == 5 - itself
        assert all_ended(children)
