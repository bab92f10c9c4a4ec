"""Going on from a checkpoint: bit-equal, past corrupt ones, and never with another task."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master.checkpointer import Restored, restore_run, save_run, warm_start
from master.learn.trainer import Trainer, choose_device
from master.record.journal import Place, segments
from master.record.resumable import check_resumable
from master.record.rundir import Record, RunFolder
from tangram_core.errors import ConfigError, RunError
from tangram_core.setup import Setup
from tangram_core.store.checkpoints import list_checkpoints, load_checkpoint, save_checkpoint
from tests.agent.agents.pair.pair_scenes import PERCEPTRON, seven
from tests.agent.builders import PAIR, setup
from tests.master.builders import (
    AGENT,
    arrival,
    assert_same_state,
    journal,
    play_on,
    small_setup,
    trainer,
)

pytestmark = pytest.mark.fast

MADE = small_setup()
PAIRS = AGENT
HUB = {"player/0": {"incarnation": 2, "sequence": 17}}
REST = Restored(Record(), HUB)
MINE: dict[str, Any] = MADE.config()
OTHER = MINE | {"tokens": {"shapes": ["parallelogram"], "scale": 1.0}}


@pytest.mark.parametrize(
    ("made", "rounds"),
    [
        (MADE, 5),
        (seven(PAIRS, PERCEPTRON, mirrored=0.5), 1),
    ],
    ids=["one token", "several"],
)
def test_a_run_goes_on_as_if_it_had_never_stopped(
    tmp_path: Path, made: Setup, rounds: int, caplog: pytest.LogCaptureFixture
) -> None:
    straight, stopped, resumed = trainer(made), trainer(made), trainer(made, seed=99)
    play_on(straight, rounds)
    play_on(stopped, rounds)
    record = Record(loop_s=12.5, scores={"mean_reward": 0.5}, scored_version=4, workers=3)
    rest = Restored(record, HUB, Place(7, 12))
    save_run(tmp_path, stopped, rest, keep=1)
    assert restore_run(tmp_path, resumed) == rest
    assert caplog.messages == []
    assert_same_state(resumed, straight)
    for one in (straight, resumed):
        play_on(one, rounds, seed=1)
    assert_same_state(resumed, straight)
    assert resumed.updates >= 20


def test_another_seed_gives_another_run() -> None:
    one, other = trainer(MADE, seed=0), trainer(MADE, seed=1)
    for made in (one, other):
        play_on(made, 2)
    assert not np.array_equal(*(made.learner.replay.state()["goal"] for made in (one, other)))


def test_nothing_to_go_on_from(tmp_path: Path) -> None:
    assert restore_run(tmp_path / "checkpoints", trainer(MADE)) is None


def test_corrupt_ones_are_set_aside_and_no_run_is_begun_anew_because_all_are(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = trainer(MADE)
    for _ in range(2):
        play_on(made, 1)
        save_run(tmp_path, made, REST, keep=2)
    first, second = list_checkpoints(tmp_path)
    damage(second)
    resumed = trainer(MADE)
    assert restore_run(tmp_path, resumed) is not None
    assert resumed.updates == 2
    assert caplog.messages == [
        f"checkpoint {second} is corrupt (checksum of learner.safetensors differs): it was renamed "
        f"to {second.name}.corrupt, and the one before is used"
    ]
    assert list_checkpoints(tmp_path) == [first]
    damage(first)
    for _ in range(2):  # the second time both are out of the way, and still no run begins
        with pytest.raises(RunError, match=r"no checkpoint in .* is intact: put one from a backup"):
            restore_run(tmp_path, trainer(MADE))
        assert len(caplog.messages) == 2


def damage(path: Path) -> None:
    data = bytearray((path / "learner.safetensors").read_bytes())
    data[-1] ^= 1
    (path / "learner.safetensors").write_bytes(data)


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (setup(PAIR, AGENT), "other settings of tokens: resume it with its own"),
        (setup(agent=AGENT, arena=3.0), "other settings of sim"),
        (setup(agent=AGENT, net={"kind": "mlp"}), "other settings of net"),
    ],
)
def test_another_task_is_refused(tmp_path: Path, other: Any, reason: str) -> None:
    save_run(tmp_path, trainer(MADE), REST, keep=1)
    with pytest.raises(RunError, match=f"cannot go on from {tmp_path}/00000000: .*{reason}"):
        restore_run(tmp_path, trainer(other))


def test_settings_of_the_agent_may_change_on_the_way(tmp_path: Path) -> None:
    made = trainer(MADE)
    play_on(made, 3)
    save_run(tmp_path, made, REST, keep=1)
    resumed = trainer(small_setup(updates_per_transition=1.0, replay_capacity=32))
    assert restore_run(tmp_path, resumed) is not None
    assert (len(resumed.learner.replay), resumed.rate_limiter.may_update()) == (32, False)
    play_on(resumed, 1)
    assert resumed.updates == 6 + 4


@pytest.mark.parametrize("lost", ["setup", "rate_limiter", "record", "hub", "generators"])
def test_a_checkpoint_that_lacks_a_part_is_refused(tmp_path: Path, lost: str) -> None:
    path = save_run(tmp_path, trainer(MADE), REST, keep=1)
    found = load_checkpoint(path)
    counters = {name: value for name, value in found.counters.items() if name != lost}
    save_checkpoint(tmp_path, 1, found.arrays, counters, keep=1)
    with pytest.raises(RunError, match=f"it is not the checkpoint of a run .KeyError: '{lost}'"):
        restore_run(tmp_path, trainer(MADE))


@pytest.mark.parametrize(
    ("forged", "reason"),
    [
        ({"setup": 3}, "other settings of net, reward, sim, task, tokens"),
        ({"rate_limiter": 3}, "it is not the checkpoint of a run .AttributeError"),
        ({"episodes": 1e400}, "it is not the checkpoint of a run .OverflowError"),
        ({"record": Record().state() | {"loop_s": "x"}}, "Expected `float`, got `str` - at"),
        ({"record": {}}, "record lacks .*: start a new run"),
        ({"record": Record().state() | {"scores": []}}, "Expected `object`, got `array`"),
        ({"journal": {"segment": 2**63 - 1}}, "its position in the journal .*<= 9007199254740992"),
        ({"journal": -1}, "its position in the journal cannot be read .* delete the checkpoint to"),
        ({"journal": {"number": True}}, "its position in the journal .*Expected `int`, got `bool`"),
    ],
)
def test_a_checkpoint_with_a_part_of_another_kind_is_refused(
    tmp_path: Path, forged: dict[str, Any], reason: str
) -> None:
    found = load_checkpoint(save_run(tmp_path, trainer(MADE), REST, keep=1))
    save_checkpoint(tmp_path, 1, found.arrays, found.counters | forged, keep=1)
    with pytest.raises(RunError, match=f"cannot go on from .*{reason}"):
        restore_run(tmp_path, trainer(MADE))


def test_a_gpu_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert [choose_device(name) for name in ("cpu", "auto")] == ["cpu", "cpu"]
    with pytest.raises(ConfigError, match=r"service.device=cuda needs a GPU.*service.device=cpu"):
        choose_device("cuda")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert [choose_device(name) for name in ("cpu", "auto", "cuda")] == ["cpu", "cuda", "cuda"]


def test_another_task_is_refused_before_anything_is_read_but_what_is_there(tmp_path: Path) -> None:
    """From the journal alone after a kill before the first checkpoint, else from that."""
    folder = RunFolder(tmp_path)
    check_resumable(folder, {})  # nothing is there yet
    journal(folder.journal, MADE).append(arrival(MADE, 1))
    check_resumable(folder, MINE)
    with pytest.raises(RunError, match="00000001.log is of another run, task or version"):
        check_resumable(folder, OTHER)
    save_run(folder.checkpoints, trainer(MADE), REST, keep=1)
    segments(folder.journal)[1].write_bytes(b"nobody reads this where there is a checkpoint")
    check_resumable(folder, MINE)
    check_resumable(folder, MINE | {"agent": MINE["agent"] | {"noise": 0.5}})
    with pytest.raises(RunError, match="made with other settings of tokens: .* from_config="):
        check_resumable(folder, OTHER)


# A warm start


def saved(folder: Path, made: Trainer) -> Path:
    """A run folder with one checkpoint."""
    save_run(folder / "checkpoints", made, REST, keep=1)
    return folder


def test_a_warm_start_takes_the_networks_and_nothing_else(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = small_setup()
    source, fresh = trainer(made), trainer(made, seed=99)
    play_on(source, 2)
    caplog.set_level(logging.INFO)
    warm_start(saved(tmp_path, source), fresh)
    (line,) = caplog.messages
    assert line == f"begins with the networks of {tmp_path} after {source.updates} updates"
    ours, theirs = fresh.learner.state(), source.learner.state()
    networks = [name for name in theirs if "optimiser" not in name and name != "updates"]
    assert len(networks) > 5
    for name in networks:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    assert not any(own.any() for name, own in ours.items() if "optimiser" in name)
    assert (fresh.updates, fresh.episodes, len(fresh.learner.replay)) == (0, 0, 0)


def test_networks_of_another_shape_can_be_taken_over(tmp_path: Path) -> None:
    """Attention does not care how many nodes there are."""
    source = trainer(MADE)
    other = trainer(setup({"shapes": ["large_triangle"], "scale": 0.8}, agent=AGENT))
    warm_start(saved(tmp_path, source), other)
    ours, theirs = (one.learner.actor.state_dict() for one in (other, source))
    for name, tensor in theirs.items():
        np.testing.assert_array_equal(ours[name], tensor, err_msg=name)


def test_a_warm_start_that_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=f"warm_start={tmp_path}: no checkpoint in"):
        warm_start(tmp_path, trainer(MADE))
    saved(tmp_path, trainer(MADE))
    wider = trainer(setup(agent=AGENT, net={"width": 16, "layers": 1}))
    with pytest.raises(RunError, match=f"warm_start={tmp_path}: weights of another"):
        warm_start(tmp_path, wider)
