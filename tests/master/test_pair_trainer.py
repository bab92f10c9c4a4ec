"""A master whose agent has several tokens: taking in, learning, going on, and its curriculum."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master.checkpointer import Restored, restore_run, save_run
from master.rundir import Record
from master.trainer import Trainer
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tests.agent.builders import random_episodes
from tests.agent.pair_scenes import PERCEPTRON, seven
from tests.master.builders import AGENT, FakeHub, arrival, close_journals, loop, trainer

pytestmark = pytest.mark.fast

LIFT: dict[str, Any] = {"mirrored": 0.5}
SLIDE: dict[str, Any] = {"backend": "physics", "motion": "slide"}
STAGES = [
    {"updates": 0, "tokens": 2, "targets": "gaussian", "spread": 0.3},
    {"updates": 3, "tokens": 5},
]
TOLD = [
    "stage 1 of 2: 2 tokens to move, targets gaussian with spread 0.3, from update 0 on",
    "stage 2 of 2: 5 tokens to move, targets uniform, from update 3 on",
]


def made_setup(agent: dict[str, Any] | None = None, **sim: Any) -> Setup:
    return seven(AGENT | {"pairs_per_transition": 2} | (agent or {}), PERCEPTRON, **sim)


def play_on(made: Trainer, rounds: int, seed: int = 0) -> None:
    for i in range(rounds):
        made.insert(random_episodes(made.setup, 2, seed=1000 * seed + i))
        while made.rate_limiter.may_update():
            made.update(i / rounds)


def everything(made: Trainer) -> dict[str, Any]:
    arrays, counters = made.state()
    flat = {f"{stem}/{n}": a.copy() for stem, part in arrays.items() for n, a in part.items()}
    return flat | {"counters": counters}


def assert_same(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    assert one.pop("counters") == other.pop("counters")
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name], err_msg=name)


def test_replay_holds_what_was_played_and_nothing_relabelled() -> None:
    """Other goals are made anew for every update, of the token that moved."""
    made = trainer(made_setup(**LIFT))
    made.insert(random_episodes(made.setup, 2))
    assert made.transitions == len(made.replay) == 14
    numbers = made.update(0.0)
    assert made.updates == 1
    assert set(numbers) >= {"critic_loss", "actor_loss", "q", "saturation"}
    assert made.batch is not None
    assert made.batch.count == made.setup.agent.batch_size


@pytest.mark.parametrize("sim", [LIFT, SLIDE])
def test_a_run_goes_on_as_if_it_had_never_stopped(tmp_path: Path, sim: dict[str, Any]) -> None:
    made = made_setup(**sim)
    straight, stopped, resumed = trainer(made), trainer(made), trainer(made, seed=99)
    play_on(straight, 2)
    play_on(stopped, 2)
    save_run(tmp_path, stopped, Restored(Record(), {}), keep=1)
    assert restore_run(tmp_path, resumed) is not None
    for one in (straight, resumed):
        play_on(one, 2, seed=1)
    assert resumed.updates > 4
    assert_same(everything(resumed), everything(straight))


def test_workers_take_the_weights_of_the_master() -> None:
    made = made_setup(**LIFT)
    master, policy = trainer(made), Policy(made)
    play_on(master, 1)
    policy.load(master.weights())
    assert policy.version == master.updates > 0


@pytest.mark.parametrize(("stages", "expected"), [(STAGES, TOLD), ([], [])])
def test_the_master_says_once_when_a_stage_begins(
    tmp_path: Path,
    stages: list[dict[str, Any]],
    expected: list[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    made = made_setup({"updates_per_transition": 1.0}, stages=stages)
    hub = FakeHub(made, [[arrival(made, 1, count=1)]])
    # Every update is published: the stage is that of what workers get.
    told = loop(tmp_path / "run", made, hub, {"publish_seconds": 0.0}, max_updates=7)
    told.run()
    close_journals()
    assert hub.values("publish") == list(range(8))
    assert [line for line in caplog.messages if "stage" in line] == expected
