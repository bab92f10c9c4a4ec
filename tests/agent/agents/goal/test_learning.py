"""Each algorithm learns a task of a few seconds; compiled updates are the same ones."""

import numpy as np
import pytest

import tests.core.toy  # noqa: F401 - registers environments
from tangram_agent.agents.goal.agent import Goal, GoalConfig
from tangram_core.conformance import play
from tangram_core.seeding import episode_generator
from tangram_core.task import Generators, Played
from tangram_tasks.gym.task import Gym, GymConfig

pytestmark = pytest.mark.slow

TASK = Gym(GymConfig(id="Toy-v0", imports=("tests.core.toy",)))


def generators(role: str, first: int, count: int) -> Generators:
    return [episode_generator(0, role, 0, 0, first + i) for i in range(count)]


@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac"])
def test_an_agent_learns_a_small_task(algorithm: str) -> None:
    config = GoalConfig(
        algorithm=algorithm, hidden=(64, 64), batch_size=128, learning_rate=1e-3, polyak=0.98
    )
    agent = Goal(config)
    learner, actor = agent.learner(TASK, 0, "cpu"), agent.actor(TASK)
    rng = {name: np.random.default_rng([0, i]) for i, name in enumerate(learner.streams)}
    actor.load(learner.broadcast())
    env, tests = TASK.make(10), TASK.make(50, "test")

    def test() -> Played:
        own = generators("test", 0, 50)
        return play(TASK, tests, own, lambda seen, past, _: actor.act(seen, past))

    before = TASK.score(test())["success"]
    for number in range(40):
        own = generators("play", number * 10, 10)
        played = play(TASK, env, own, actor.act)
        learner.insert(played.episodes, rng)
        for _ in range(10 if number > 2 else 0):
            learner.update(0.0, rng)
        actor.load(learner.broadcast())
    assert before < 0.8
    assert TASK.score(test())["success"] >= 0.95


@pytest.mark.check
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own
@pytest.mark.parametrize("algorithm", ["td3", "sac"])
def test_compiled_updates_are_the_same(algorithm: str) -> None:
    agent = Goal(GoalConfig(algorithm=algorithm, hidden=(8,), batch_size=16, replay_capacity=200))
    plain = agent.learner(TASK, 0, "cpu")
    compiled = agent.learner(TASK, 0, "cpu", compiled=True)
    compiled.prepare()
    env = TASK.make(4)
    own = [np.random.default_rng(i) for i in range(4)]
    actor = agent.actor(TASK)
    actor.load(plain.broadcast())
    played = play(TASK, env, own, actor.act)
    numbers = []
    for learner in (plain, compiled):
        rng = {name: np.random.default_rng([0, i]) for i, name in enumerate(learner.streams)}
        learner.insert(played.episodes, rng)
        numbers.append([learner.update(0.0, rng) for _ in range(3)])
    for first, second in zip(*numbers, strict=True):
        assert first == pytest.approx(second, rel=1e-3, abs=1e-5)
