"""Environments of gymnasium as a task: what is played, what it is worth, and what is refused."""

import sys
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

import tests.core.toy  # noqa: F401 - registers environments
from tangram_core.conformance import play
from tangram_core.errors import ConfigError, RunError
from tangram_core.seeding import episode_generator
from tangram_core.spec import Episodes
from tangram_core.task import Played
from tangram_tasks.goal_env import TaskEnv
from tangram_tasks.gym.task import Gym, GymConfig

pytestmark = pytest.mark.fast

TOY = GymConfig(id="Toy-v0", imports=("tests.core.toy",))


def generators(count: int) -> list[np.random.Generator]:
    return [episode_generator(1, "test", 0, 0, i) for i in range(count)]


def towards(seen: dict[str, np.ndarray], *_: object) -> np.ndarray:  # type: ignore[type-arg]
    """A rule that solves the toy: go at the goal."""
    way = seen["desired_goal"] - seen["achieved_goal"]
    return np.clip(way * 10, -1, 1).astype(np.float32)


def test_to_make_a_task_makes_no_environment() -> None:
    task = Gym(TOY)
    assert task.identity()["task"]["id"] == "Toy-v0"
    assert "judge" not in vars(task)
    assert task.spec.horizon == 10
    assert "judge" in vars(task)


def test_the_spec_is_what_the_environment_says() -> None:
    spec = Gym(TOY).spec
    assert [(f.name, f.shape, f.per, f.dtype) for f in spec.fields] == [
        ("observation", (2,), "moment", "f4"),
        ("achieved_goal", (2,), "moment", "f4"),
        ("desired_goal", (2,), "episode", "f4"),
    ]
    assert (spec.action_size, spec.achieved, spec.desired) == (2, "achieved_goal", "desired_goal")
    assert spec.rewards == (-1.0, 0.0)  # all that its reward was seen to be
    low, _ = Gym(replace(TOY, id="Dear-v0")).spec.rewards  # -5 far away
    assert low < -5.0


def test_an_action_covers_the_bounds_of_the_environment() -> None:
    judge = Gym(TOY).judge
    ends = np.array([[-1, -1], [1, 1], [0, 0]], np.float32)
    assert judge.scaled(ends) == pytest.approx(np.array([[-0.2, -0.2], [0.1, 0.1], [-0.05, -0.05]]))


def test_what_terminates_plays_on_and_is_marked() -> None:
    task = Gym(TOY)
    env = task.make(4)
    played = play(task, env, generators(4), towards)
    terminated = played.episodes.terminated.astype(bool)
    assert terminated.any(1).all()
    assert (terminated == (played.episodes.rewards == 0)).all()
    unmarked = Gym(replace(TOY, ends=False))
    again = play(unmarked, unmarked.make(4), generators(4), towards)
    assert not again.episodes.terminated.any()
    assert (again.episodes.rewards == played.episodes.rewards).all()


@pytest.mark.parametrize("name", ["Rows", "Row", "Any", "Never"])
def test_what_terminates_by_a_function_of_goals_is_asked_for_each_row(name: str) -> None:
    places = np.array([[0, 0], [0, 3], [0.5, 0]])
    ended = Gym(replace(TOY, id=f"{name}-v0")).ended(places, places, np.zeros(3, bool))
    assert ended.tolist() == [False, name != "Never", False]


def test_scores_count_up_to_the_first_end() -> None:
    """Two episodes of four steps: one ends in its second, one is there for a while and leaves."""
    episodes = Episodes(
        {
            "actions": np.zeros((2, 4, 1), np.float32),
            "rewards": np.array([[-1, 0, -1, -1], [-1, -1, 0, -1]], np.float32),
            "terminated": np.array([[0, 1, 0, 0], [0, 0, 0, 0]], np.uint8),
        }
    )
    facts = {"is_success": np.array([[0, 0, 1, 0, 0], [0, 0, 0, 1, 0]], bool)}
    found = Gym(TOY).score(Played(episodes, facts))
    assert found == {"success": 0.5, "success_any": 1.0, "mean_return": -2.0, "steps": 2.5}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"id": ""}, "task.id must name an environment, got '': set task.id=FetchReach-v4"),
        ({"id": "os:Toy-v0"}, "got 'os:Toy-v0': set task.imports=[os] task.id=Toy-v0"),
        ({"id": "Nowhere-v0"}, "task.id=Nowhere-v0 is not registered"),
        ({"imports": ("no_such",)}, "the module no_such, which is not imported unless you name it"),
        ({"id": "Endless-v0"}, "no time limit: register it with max_episode_steps"),
        ({"id": "CartPole-v1"}, "choose a goal environment"),
        ({"id": "Pictures-v0"}, "its observation is Box(0, 255, (8, 8, 3), uint8)"),
        ({"id": "Discrete-v0"}, "its actions are Discrete(3)"),
        ({"id": "Unbounded-v0"}, "must be a bounded vector of numbers"),
        ({"id": "OneByOne-v0"}, "its compute_reward does not take arrays of goals (n, 2)"),
        ({"id": "Pays-v0"}, "its step rewards differ from compute_reward"),
        ({"id": "Untold-v0"}, "its info lacks is_success"),
    ],
)
def test_what_cannot_be_learned_is_refused_by_name(changes: dict[str, object], told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Gym(replace(TOY, **changes)).check(plays=True)  # type: ignore[arg-type]
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_colon_imports_nothing() -> None:
    with pytest.raises(ConfigError, match="colon"):
        GymConfig(id="this:Toy-v0")
    assert "this" not in sys.modules


def test_an_end_that_no_goal_tells_is_refused_in_play() -> None:
    task = Gym(replace(TOY, id="Ends-v0"))
    with pytest.raises(ConfigError, match="hindsight cannot tell .* set task.ends=false"):
        play(task, task.make(3), generators(3), towards)
    task = Gym(replace(TOY, id="Ends-v0", ends=False))
    play(task, task.make(3), generators(3), towards)


def test_a_goal_that_moves_is_refused_in_play() -> None:
    task = Gym(replace(TOY, id="Wanders-v0", ends=False))
    with pytest.raises(RunError, match="goal moved"):
        play(task, task.make(3), generators(3), towards)


def test_lockstep_is_refused_where_an_episode_hangs_on_the_one_before() -> None:
    Gym(TOY).check_exact()
    Gym(replace(TOY, id="Wears-v0", fresh=True)).check_exact()
    with pytest.raises(ConfigError, match="set task.fresh=true"):
        Gym(replace(TOY, id="Wears-v0")).check_exact()


def test_it_is_an_environment_of_gymnasium_again_and_tells_success_though_nothing_ends() -> None:
    found = list[bool]()
    with closing(TaskEnv(Gym(replace(TOY, ends=False)))) as env:
        env.action_space.seed(0)
        for seed in range(20):
            env.reset(seed=seed)
            seen, reward, terminated, truncated, info = env.step(env.action_space.sample())
            goals = seen["achieved_goal"], seen["desired_goal"]
            assert env.compute_reward(*goals, info) == reward
            assert info["is_success"] is (reward == 0.0)
            assert (terminated, truncated, env.render()) == (False, False, None)
            found.append(info["is_success"])
    assert len(set(found)) == 2
