"""It learns to push a square within seconds."""

from contextlib import closing

import numpy as np
import pytest

from tangram_agent.agents.push.agent import Pushing, PushingConfig
from tangram_core.conformance import play
from tests.agent.agents.push.test_pushing import SQUARE, generators

pytestmark = pytest.mark.slow


def test_it_learns_to_push_a_square() -> None:
    agent = Pushing(PushingConfig(width=32, batch_size=64, polyak=0.98, looked_at=16))
    learner, actor = agent.learner(SQUARE, 0, "cpu"), agent.actor(SQUARE)
    rng = {name: np.random.default_rng([0, i]) for i, name in enumerate(learner.streams)}
    actor.load(learner.broadcast())
    with closing(SQUARE.make(10)) as env, closing(SQUARE.make(20, "test")) as tests:

        def solved() -> float:
            own = generators("test", 0, 20)
            found = play(SQUARE, tests, own, lambda seen, past, _: actor.act(seen, past))
            return SQUARE.score(found)["solved"]

        before = solved()
        for number in range(12):
            found = play(SQUARE, env, generators("play", number * 10, 10), actor.act)
            learner.insert(found.episodes, rng)
            for _ in range(40 if number > 3 else 0):
                learner.update(0.0, rng)
            actor.load(learner.broadcast())
        assert before <= 0.2
        assert solved() >= 0.5
