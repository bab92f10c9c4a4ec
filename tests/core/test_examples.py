"""The examples of the documentation learn: an agent of one's own, a task of one's own."""

import numpy as np
import pytest

from tangram_core.conformance import play
from tangram_core.seeding import episode_generator
from tests.core.examples import example
from tests.sim.builders import evaluation_generators

pytestmark = pytest.mark.slow


def test_the_agent_of_the_examples_learns_their_task() -> None:
    task, td3 = example("point").Point(), example("td3")
    agent = td3.TD3(td3.TD3Config(batch_size=128, hidden=(64, 64)))
    learner, actor = agent.learner(task, 0, "cpu"), agent.actor(task)
    rng = {name: np.random.default_rng([0, i]) for i, name in enumerate(learner.streams)}
    actor.load(learner.broadcast())
    env = task.make(10)
    for number in range(35):
        own = [episode_generator(0, "player", 0, 0, number * 10 + i) for i in range(10)]
        learner.insert(play(task, env, own, actor.act).episodes, rng)
        for _ in range(20 if number > 3 else 0):
            learner.update(0.0, rng)
        actor.load(learner.broadcast())
    own = evaluation_generators(50)
    tests = play(task, task.make(50), own, lambda seen, past, _: actor.act(seen, past))
    assert task.score(tests)["success"] >= 0.9
