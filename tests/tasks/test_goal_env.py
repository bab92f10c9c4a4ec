"""Tasks as gymnasium sees them: place, and push."""

import copy
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tangram_core.errors import ConfigError
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import TokensConfig, make_layout
from tangram_tasks.goal_env import SQUARE_SCALE, TaskEnv, place
from tangram_tasks.place import Place
from tangram_tasks.register import IDS
from tests.agent.agents.outline.outlines import TWO, outline_setup
from tests.sim.builders import SEVEN, TRIO

pytestmark = pytest.mark.fast


@pytest.fixture
def made() -> Iterator[list[gymnasium.Env[Any, Any]]]:
    envs: list[gymnasium.Env[Any, Any]] = []
    yield envs
    for env in envs:
        env.close()


def kinematic(**settings: Any) -> TaskEnv:
    return place(backend="kinematic", **settings)


GAME = {"shapes": SEVEN, "scale": 0.6}
PAIR = ("square", "small_triangle")
PLAYED = [
    {},
    {"shapes": TRIO, "scale": 0.8, "pixels": 64, "actions_per_token": 2, "reward": "dense"},
    GAME | {"allow_flip": True, "starts": "outside"},
    GAME | {"targets": "figures", "mirrored": 0.5},
    GAME | {"targets": "connected"},
]


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        *((name, {}) for name in IDS),
        ("Tangram-v0", PLAYED[1]),
        *(("Tangram-v0", {"backend": "kinematic"} | one) for one in PLAYED),
    ],
)
def test_gymnasium_checks_it_without_a_warning(
    name: str, settings: dict[str, Any], made: list[Any]
) -> None:
    env = gymnasium.make(name, render_mode="rgb_array", **settings)
    made.append(env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_the_package_loads_nothing_and_registration_no_engine() -> None:
    script = (
        "import sys, tangram_tasks; assert not {'gymnasium', 'numpy', 'torch'} & set(sys.modules); "
        "import importlib, tangram_tasks.register, gymnasium; "
        "importlib.reload(tangram_tasks.register); "
        "assert {'Tangram-v0', 'Push7-v0'} <= set(gymnasium.registry); "
        "assert not {'pybullet', 'tangram_tasks.goal_env'} & set(sys.modules); "
        "gymnasium.make('Tangram-v0', backend='kinematic').reset(); "
        "assert 'pybullet' not in sys.modules; "
        "gymnasium.make('Tangram-v0').reset(); "
        "assert 'pybullet' in sys.modules"
    )
    command = [sys.executable, "-W", "error", "-c", script]
    done = subprocess.run(command, check=True, timeout=100, capture_output=True)
    assert done.stdout + done.stderr == b""  # nor does the engine tell when it was built


def test_made_by_module_and_name(made: list[Any]) -> None:
    made.append(gymnasium.make("tangram_tasks.register:Tangram-v0", backend="kinematic"))
    assert isinstance(made[0].unwrapped, TaskEnv)


def test_an_episode_is_cut_by_itself_whatever_its_settings(made: list[Any]) -> None:
    for name, settings, horizon in (
        ("Tangram7-v0", {"backend": "kinematic"}, 7),
        ("Tangram-v0", {"backend": "kinematic", "actions_per_token": 3}, 3),
        ("Push-v0", {}, 8),
        ("Push-v0", {"shapes": PAIR}, 16),
    ):
        made.append(gymnasium.make(name, **settings))
        made[-1].reset(seed=0)
        made[-1].action_space.seed(0)
        ends = [any(made[-1].step(made[-1].action_space.sample())[2:4]) for _ in range(horizon)]
        assert ends == [False] * (horizon - 1) + [True]
        with pytest.raises(
            RuntimeError, match=f"episode of {horizon} steps is over or was not begun"
        ):
            made[-1].unwrapped.step(made[-1].action_space.sample())


def test_observation() -> None:
    env = kinematic(shapes=("square", "small_triangle"))
    observation, info = env.reset(seed=0)
    assert info == {}
    assert {k: v.shape for k, v in observation.items()} == {
        "observation": (16,),
        "achieved_goal": (14,),
        "desired_goal": (14,),
    }
    (task, rng), lies = (env.task, np.random.default_rng(0)), observation["achieved_goal"]
    with closing(task.make(1)) as other:
        seen = other.reset([rng])
    np.testing.assert_array_equal(lies, seen["corners"].ravel())
    np.testing.assert_array_equal(observation["observation"], [*lies, 0, 0])
    np.testing.assert_array_equal(observation["desired_goal"], seen["goals"].ravel())
    after, *_ = env.step(np.array([1.0, 0, 0, 0], dtype=np.float32))
    np.testing.assert_array_equal(after["observation"][-2:], [0, 1])
    np.testing.assert_array_equal(observation["observation"][-2:], [0, 0])  # its own arrays


def test_horizon_refusal_and_info() -> None:
    env = kinematic(shapes=("square", "small_triangle"))
    env.reset(seed=0)
    action = np.array([-1.0, 0.1, 0, 0], dtype=np.float32)
    _, _, terminated, truncated, info = env.step(action)
    assert (terminated, truncated) == (False, False)
    assert set(info) == {"coverage", "is_success"}
    _, _, terminated, truncated, info = env.step(action)
    assert (terminated, truncated) == (False, True)  # token 1 is left: only the steps ran out
    assert info["refused"] == "token 0 is placed already: it had its 1 actions"
    env.reset()
    assert "refused" not in env.step(action)[-1]
    _, _, terminated, truncated, _ = env.step(-action)
    assert (terminated, truncated) == (True, False)  # all are placed


@pytest.mark.parametrize("shapes", [("square",), ("square", "small_triangle")])
@pytest.mark.parametrize("actions", [1, 2])
def test_a_lone_token_of_several_actions_ends_by_a_time_limit(
    shapes: tuple[str, ...], actions: int
) -> None:
    env = kinematic(shapes=shapes, actions_per_token=actions)
    env.reset(seed=0)
    named = np.repeat(np.linspace(-1.0, 1.0, len(shapes)), actions)
    ends = [
        env.step(np.array([*[token] * (len(shapes) > 1), 0, 0, 0], dtype=np.float32))[2:4]
        for token in named
    ]
    limit = len(shapes) == 1 and actions > 1  # it could go on
    assert ends == [(False, False)] * (len(named) - 1) + [(not limit, limit)]


def nearly(env: TaskEnv, miss: float = 0.03) -> dict[str, Any]:
    """What is told of an action that misses about twice that share, its reward included."""
    seen, _ = env.reset(seed=0)
    poses = make_layout(TokensConfig(("square",), SQUARE_SCALE)).poses
    goal, start = (poses(seen[name].reshape(1, 4, 2)) for name in ("desired_goal", "achieved_goal"))
    motion = (goal - start)[0, 0]
    motion[2] = np.angle(np.exp(1j * motion[2]))
    motion[:2] += miss * 0.4
    _, reward, _, _, info = env.step((motion / [2.0, 2.0, np.pi]).astype(np.float32))
    return info | {"reward": reward}


@pytest.mark.parametrize(("miss", "expected"), [(0.02, True), (0.03, False)])
def test_success_is_95_percent_of_the_target_covered(miss: float, expected: bool) -> None:
    info = nearly(kinematic(), miss)
    assert 0.9 < info["coverage"] < 0.98
    assert info["is_success"] is expected is (info["coverage"] >= 0.95)


def test_an_outline_is_solved_by_its_iou() -> None:
    """A coverage of .96 without overlap is an IoU of .92; only the first is above .95."""
    layout, task = make_layout(TokensConfig(**TWO)), outline_setup().task
    with closing(task.make(1)) as env:
        env.reset([np.random.default_rng(0)])
        start, goal = (layout.poses(env.facts()[name])[0] for name in ("corners", "goals"))
        away = goal[1, :2] - goal[0, :2]
        goal[1, :2] += 0.015 * away / np.linalg.norm(away)
        for token, motion in enumerate(goal - start):
            motion[2] = np.angle(np.exp(1j * motion[2]))
            action = np.array([2 * token - 1, *motion / [2.0, 2.0, np.pi]], np.float32)
            env.step(action[None])
        told = env.told()
    assert 0.95 < told["coverage"] < 0.97
    assert not told["is_success"]


def test_outlines_pay_shared_area_once() -> None:
    """Two equal tokens that lie on the same piece cover one piece."""
    task = outline_setup().task
    with closing(task.make(1)) as env:
        seen = env.reset([np.random.default_rng(0)])
        corners = env.facts()["goals"].reshape(1, 2, 3, 2)[:, [0, 0]].reshape(1, 6, 2)
    assert task.rewards(corners, seen["goals"]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("source", ["polygon", "camera"])
def test_camera_is_reported_and_may_pay(source: str) -> None:
    square = TokensConfig(("square",), SQUARE_SCALE)
    world = SimConfig(backend="kinematic", pixels=64)
    info = nearly(TaskEnv(Place(square, world, RewardConfig(source=source))))
    assert 0.7 < info["reward_camera"] <= 1.0
    assert (info["reward"] == info["reward_camera"]) == (source == "camera")
    blind = Place(square, SimConfig(backend="kinematic"), RewardConfig())
    assert "reward_camera" in nearly(TaskEnv(blind, purpose="test"))  # tests measure it


@pytest.mark.parametrize("reward", ["overlap", "dense"])
def test_compute_reward_is_the_reward_of_the_step(reward: str) -> None:
    env = kinematic(shapes=TRIO, reward=reward)
    achieved, desired, rewards = [], [], []
    env.action_space.seed(0)
    for seed in range(5):
        env.reset(seed=seed)
        done = False
        while not done:
            observation, paid, *ends, info = env.step(env.action_space.sample() * 0.3)
            done = any(ends)
            achieved.append(observation["achieved_goal"])
            desired.append(observation["desired_goal"])
            rewards.append(paid)
            single = env.compute_reward(achieved[-1], desired[-1], info)
            assert isinstance(single, float)
            assert single == pytest.approx(paid, abs=1e-12)
    together = env.compute_reward(np.stack(achieved), np.stack(desired), [{}] * len(rewards))
    assert together.shape == (15,)
    np.testing.assert_allclose(together, rewards, atol=1e-12)


def test_goals_of_other_shapes_are_refused_and_copies_too() -> None:
    env = kinematic()
    own = env.reset(seed=0)[0]["achieved_goal"]
    for achieved, desired in (
        (np.tile(own, 2), own),
        (own[None], own),
        ([own] * 2, [own] * 3),
        (own[None, None], own[None, None]),
    ):
        with pytest.raises(ValueError, match="a goal must have shape"):
            env.compute_reward(achieved, desired, {})
    with pytest.raises(TypeError, match="holds an engine and cannot be copied"):
        copy.deepcopy(env)


def test_render() -> None:
    env = kinematic(render_mode="rgb_array", render_size=100)
    env.reset(seed=0)
    before = env.render()
    assert before is not None
    assert (before.shape, before.dtype) == ((100, 100, 3), np.uint8)
    env.step(np.array([0.3, 0.3, 0.3], dtype=np.float32))
    assert not np.array_equal(before, env.render())
    env.reset(seed=0)
    np.testing.assert_array_equal(before, env.render())  # the mark of the last move is gone
    assert kinematic().render() is None


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"render_mode": "3d"}, "render_mode must be None or rgb_array, got '3d'"),
        ({"gravity": 9.81}, "there is no setting sim.gravity: delete it"),
        ({"render_size": 0}, "render_size must be between 1 and 4096, got 0"),
        ({"render_size": 10.5}, "render_size must be a whole number, got 10.5: set 240"),
        ({"scale": "big"}, "tokens.scale must be a number, got big"),
        ({"allow_flip": True}, "sim.allow_flip=true needs a token that is not its own mirror"),
    ],
)
def test_refused_settings(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        kinematic(**settings)
