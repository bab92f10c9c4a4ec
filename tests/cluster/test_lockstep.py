"""Lockstep: the same seed gives the same weights, through stops and kills as well."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import zmq

from tangram_core.errors import TangramError
from tangram_core.store.checkpoints import list_checkpoints, load_checkpoint
from tests.cluster.processes import LIMIT_S, pids_of, refused, run, started
from worker.status import ask_status

pytestmark = pytest.mark.cluster

UPDATES = 150
STEP = (
    "service.mode=lockstep",
    "workers=2",
    f"max_updates={UPDATES}",
    "sim=kinematic",
    "net=mlp",
    "agent.learning_starts=64",
    "service.eval_seconds=1000",
    "service.eval_episodes=4",
)


def until_updates(folder: Path, updates: int) -> None:
    """Wait until a run that goes on has made so many updates."""
    end, done = time.monotonic() + LIMIT_S, -1.0
    with zmq.Context() as context:
        while done < updates:
            assert time.monotonic() < end, f"{done} updates after {LIMIT_S} s"
            try:
                done = ask_status(str(folder), context, 5.0).numbers["updates"]
            except TangramError:
                time.sleep(0.05)  # it is not there yet
    assert done < UPDATES, "it was over before it could be disturbed"


def assert_same(one: Path, other: Path) -> None:
    """Every number of the final checkpoints, the replay and the generators included."""
    ours, theirs = (load_checkpoint(list_checkpoints(p / "checkpoints")[-1]) for p in (one, other))
    assert ours.updates == theirs.updates == UPDATES
    for stem, tensors in ours.arrays.items():
        assert tensors.keys() == theirs.arrays[stem].keys()
        for name, tensor in tensors.items():
            np.testing.assert_array_equal(tensor, theirs.arrays[stem][name], err_msg=name)
    for name in ("episodes", "generators"):
        assert ours.counters[name] == theirs.counters[name], name
    assert ours.counters["rate_limiter"] == pytest.approx(theirs.counters["rate_limiter"])


def test_the_same_numbers_come_twice_and_stops_and_kills_in_the_middle_change_nothing(
    tmp_path: Path,
) -> None:
    """tangram-train starts them again; a master learns again what its checkpoint had not seen."""
    straight, folder = tmp_path / "straight", tmp_path / "stopped"
    run("tangram-train", f"run_dir={straight}", *STEP, cwd=tmp_path)
    settings = (f"run_dir={folder}", *STEP, "service.checkpoint_minutes=0.01")
    with started("tangram-train", *settings, cwd=tmp_path) as process:
        until_updates(folder, 10)
        process.terminate()
        assert process.wait(LIMIT_S) == 0
    reached = load_checkpoint(list_checkpoints(folder / "checkpoints")[-1], []).updates
    with started("tangram-train", *settings, "resume=auto", cwd=tmp_path) as process:
        for victim, more in (("role=player", 10), ("tangram-master", 20)):
            until_updates(folder, reached + more)  # so the players have joined, too
            found = [pid for pid in pids_of(folder) if victim in _line(pid)]
            os.kill(min(found), signal.SIGKILL)
        assert process.wait(LIMIT_S) == 0
    assert_same(folder, straight)


def _line(pid: int) -> str:
    return (Path("/proc") / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode()


def test_a_master_is_told_of_workers_in_lockstep_alone(tmp_path: Path) -> None:
    told = refused("tangram-master", f"run_dir={tmp_path / 'run'}", "workers=2", cwd=tmp_path)
    assert "workers=2 changes nothing with service.mode=async in tangram-master" in told
