"""A master whose agent has several tokens: taking in and learning."""

from typing import Any

import pytest

from tangram_core.setup import Setup
from tangram_core.store.checkpoints import ACTING
from tests.agent.agents.pair.pair_scenes import PERCEPTRON, seven
from tests.agent.builders import Policy, random_episodes, setup
from tests.master.builders import AGENT, play_on, trainer

pytestmark = pytest.mark.fast


def made_setup(agent: dict[str, Any] | None = None, **sim: Any) -> Setup:
    return seven(AGENT | (agent or {}), PERCEPTRON, **sim)


def test_replay_holds_what_was_played_and_nothing_relabelled() -> None:
    """Other goals are made anew for every update, of the token that moved."""
    made = trainer(made_setup(mirrored=0.5))
    made.insert(random_episodes(made.setup, 2))
    assert made.transitions == len(made.learner.replay) == 14
    numbers = made.update(0.0)
    assert made.updates == 1
    assert set(numbers) >= {"critic_loss", "actor_loss", "q", "saturation"}
    assert len(made.learner.evidence()["reward"]) == made.setup.agent.config.batch_size


def test_a_critic_without_a_say_stays_with_the_master_and_in_checkpoints() -> None:
    made = setup(agent=AGENT | {"kind": "pair", "gamma": 0.0})
    master, policy = trainer(made), Policy(made)
    play_on(master, 1)
    arrays, _ = master.state()
    policy.load(arrays[ACTING])
    policy.follow(master.weights())
    parts = [
        {name.partition(".")[0] for name in one}
        for one in (master.weights().tensors, arrays[ACTING])
    ]
    assert parts == [{"actor"}, {"actor", "critic"}]
