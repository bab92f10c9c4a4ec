"""A master whose agent has several tokens: taking in, learning, and its curriculum."""

import logging
from pathlib import Path
from typing import Any

import pytest

from tangram_agent.checkpoints import ACTING
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.types import Weights
from tests.agent.builders import random_episodes, setup
from tests.agent.pair_scenes import PERCEPTRON, seven
from tests.master.builders import AGENT, FakeHub, arrival, loop, play_on, trainer

pytestmark = pytest.mark.fast

STAGES = [
    {"updates": 0, "tokens": 2, "targets": "gaussian", "spread": 0.3},
    {"updates": 3, "tokens": 5},
]
TOLD = [
    "stage 1 of 2: 2 tokens to move, targets gaussian with spread 0.3, from update 0 on",
    "stage 2 of 2: 5 tokens to move, targets uniform, from update 3 on",
]


def made_setup(agent: dict[str, Any] | None = None, **sim: Any) -> Setup:
    return seven(AGENT | (agent or {}), PERCEPTRON, **sim)


def test_replay_holds_what_was_played_and_nothing_relabelled() -> None:
    """Other goals are made anew for every update, of the token that moved."""
    made = trainer(made_setup(mirrored=0.5))
    made.insert(random_episodes(made.setup, 2))
    assert made.transitions == len(made.replay) == 14
    numbers = made.update(0.0)
    assert made.updates == 1
    assert set(numbers) >= {"critic_loss", "actor_loss", "q", "saturation"}
    assert made.batch is not None
    assert made.batch.count == made.setup.agent.batch_size


def test_a_critic_without_a_say_stays_with_the_master_and_in_checkpoints() -> None:
    made = setup(agent=AGENT | {"readout": "pair", "motion": "learned", "gamma": 0.0})
    master, policy = trainer(made), Policy(made)
    play_on(master, 1)
    arrays, _ = master.state()
    policy.load(Weights(1, arrays[ACTING]))
    policy.follow(master.weights())
    parts = [
        {name.partition(".")[0] for name in one}
        for one in (master.weights().tensors, arrays[ACTING])
    ]
    assert parts == [{"actor", "motion"}, {"actor", "critic", "motion"}]


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
    assert hub.values("publish") == list(range(8))
    assert [line for line in caplog.messages if "stage" in line] == expected
