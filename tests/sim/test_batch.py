"""Episodes of many environments in step: what moves, what is refused, what is paid."""

from typing import Any

import numpy as np
import pytest

from tangram_sim.actions import chosen_tokens, velocities
from tangram_sim.arrays import Floats
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.errors import ConfigError
from tangram_sim.geometry import overlap_share
from tangram_sim.layout import Layout
from tangram_sim.sampling import sample_batch
from tangram_sim.seeding import evaluation_generators
from tests.sim.builders import SEVEN, TRIO, layout_of

pytestmark = pytest.mark.fast

PAIR = layout_of("square", "small_triangle")


def make_env(
    layout: Layout, count: int = 4, reward: str = "overlap", source: str = "polygon", **sim: Any
) -> BatchedEnv:
    settings = {"backend": "kinematic", **sim}
    return BatchedEnv(layout, SimConfig(**settings), RewardConfig(reward, source), count)


def begun(env: BatchedEnv) -> BatchedEnv:
    env.reset(evaluation_generators(env.count))
    return env


@pytest.mark.parametrize(
    ("tokens", "first", "expected"),
    [
        (1, [-1.0, 1.0], [0, 0]),
        (2, [-1.0, -1e-9, 0.0, 1.0], [0, 0, 1, 1]),
        (3, [-1.0, -0.34, -0.33, 0.33, 0.34, 1.0], [0, 0, 1, 1, 2, 2]),
        (7, [-1.0, -0.72, -0.71, 0.0, 0.99, 1.0], [0, 0, 1, 3, 6, 6]),
    ],
)
def test_first_entry_names_the_token(tokens: int, first: list[float], expected: list[int]) -> None:
    actions = np.zeros((len(first), 4))
    actions[:, 0] = first
    assert chosen_tokens(actions, tokens).tolist() == expected


def test_full_scale_crosses_the_arena_and_makes_half_a_turn() -> None:
    sim = SimConfig(arena=3.0)
    actions = np.array([[1.0, -0.5, 1.0], [0.0, 0.1, -0.5]])
    expected = [[3.0, -1.5, np.pi], [0.0, 0.3, -np.pi / 2.0]]
    np.testing.assert_allclose(velocities(actions, sim), expected)
    named = np.concatenate([np.ones((2, 1)), actions], axis=1)
    np.testing.assert_allclose(velocities(named, sim), expected)


@pytest.mark.parametrize("backend", ["physics", "kinematic"])
@pytest.mark.parametrize("arena", [2.0, 0.7])
def test_every_pose_is_reached_in_one_action(backend: str, arena: float) -> None:
    layout = layout_of("square", scale=0.5 * arena)
    env = make_env(layout, 4, backend=backend, arena=arena)
    generators = evaluation_generators(4)
    for _ in range(16):
        env.reset(generators)
        start, goal = layout.poses(env.corners)[:, 0], layout.poses(env.goals)[:, 0]
        motion = goal - start
        motion[:, 2] = np.angle(np.exp(1j * motion[:, 2]))
        actions = motion / [arena, arena, np.pi]
        assert np.abs(actions).max() <= 1.0
        result = env.step(actions)
        np.testing.assert_allclose(result.overlap, 1.0, atol=1e-6)
        np.testing.assert_allclose(result.rewards, 1.0, atol=1e-6)
        assert result.done
    env.close()


def test_shapes_and_sizes() -> None:
    env = make_env(layout_of(*SEVEN, scale=0.6), 5, actions_per_token=2)
    assert (env.horizon, env.action_size) == (14, 4)
    begun(env)
    assert env.corners.shape == env.goals.shape == (5, 23, 2)
    assert env.placed.shape == (5, 7)
    assert not env.placed.any()
    assert make_env(layout_of("square"), actions_per_token=3).action_size == 3


def test_an_episode_of_two_tokens() -> None:
    """One environment each: both tokens, the same token twice, the second first."""
    env = begun(make_env(PAIR, 3))
    begin = env.corners.copy()
    first = np.array([[-1.0, 0.1, 0, 0], [-1.0, 0.1, 0, 0], [1.0, 0.1, 0, 0]])
    result = env.step(first)
    assert (result.done, result.refused.tolist()) == (False, [False] * 3)
    assert env.placed.tolist() == [[True, False], [True, False], [False, True]]
    moved = (env.corners - begin)[..., 0] / 0.2
    np.testing.assert_allclose(moved, [[1] * 4 + [0] * 3] * 2 + [[0] * 4 + [1] * 3], atol=1e-9)
    before = env.corners.copy()
    second = np.array([[1.0, 0, 0.1, 0], [-1.0, 0, 0.1, 0], [-1.0, 0, 0.1, 0]])
    result = env.step(second)
    assert (result.done, result.refused.tolist()) == (True, [False, True, False])
    assert env.placed.tolist() == [[True, True], [True, False], [True, True]]
    moved = (env.corners - before)[..., 1] / 0.2
    rows = [[0] * 4 + [1] * 3, [0] * 7, [1] * 4 + [0] * 3]
    np.testing.assert_allclose(moved, rows, atol=1e-9)


def test_several_actions_for_each_token() -> None:
    env = begun(make_env(PAIR, 1, actions_per_token=2))
    action = np.array([[-1.0, 0.1, 0, 0]])
    flags = []
    for _ in range(env.horizon):
        result = env.step(action)
        flags.append((env.placed[0].tolist(), bool(result.refused[0]), result.done))
    assert flags == [
        ([False, False], False, False),
        ([True, False], False, False),
        ([True, False], True, False),
        ([True, False], True, True),
    ]


def test_the_next_episode_begins_anew() -> None:
    env = begun(make_env(PAIR))
    first = env.corners.copy()
    for _ in range(env.horizon):
        env.step(np.full((4, 4), -1.0))
    begun(env)
    assert env.steps_done == 0
    assert not env.placed.any()
    np.testing.assert_array_equal(env.corners, first)


def test_targets_and_starts_differ_and_come_from_the_generators() -> None:
    env = begun(make_env(PAIR))
    targets = env.goals.copy()
    assert np.abs(env.corners - targets).max() > 0.1
    generators = evaluation_generators(4)
    sampled = sample_batch(PAIR, env.sim, generators)
    np.testing.assert_allclose(targets, PAIR.corners(sampled))
    sampled = sample_batch(PAIR, env.sim, generators)
    np.testing.assert_allclose(env.corners, PAIR.corners(sampled))


@pytest.mark.parametrize("reward", ["overlap", "dense", "pose"])
def test_rewards_are_those_of_the_reward_function(reward: str) -> None:
    env = begun(make_env(layout_of(*TRIO), 16, reward=reward))
    rng = np.random.default_rng(0)
    for _ in range(env.horizon):
        result = env.step(rng.uniform(-0.3, 0.3, (16, 4)))
        np.testing.assert_array_equal(result.rewards, env.reward_fn(env.corners, env.goals))
        share = overlap_share(env.corners, env.goals, env.layout)
        np.testing.assert_array_equal(result.overlap, share)
        assert result.camera_rewards is None


def near_goals(env: BatchedEnv) -> Floats:
    """Actions of one token that end within about its size of the target."""
    start, goal = env.layout.poses(env.corners)[:, 0], env.layout.poses(env.goals)[:, 0]
    noise = np.random.default_rng(0).normal(0.0, 0.1, start.shape)
    actions: Floats = (goal - start + noise) / [env.sim.arena, env.sim.arena, np.pi]
    return actions


@pytest.mark.parametrize("backend", ["physics", "kinematic"])
def test_camera_reports_and_pays(backend: str) -> None:
    results = []
    for source in ("polygon", "camera"):
        env = make_env(layout_of("square"), 8, source=source, backend=backend, pixels=64)
        begun(env)
        results.append(env.step(near_goals(env)))
        env.close()
    exact, seen = results
    assert exact.camera_rewards is not None
    assert seen.camera_rewards is not None
    np.testing.assert_array_equal(exact.camera_rewards, seen.camera_rewards)
    np.testing.assert_array_equal(seen.rewards, seen.camera_rewards)
    assert np.abs(seen.rewards - exact.rewards).max() > 1e-6
    assert np.abs(seen.rewards - exact.rewards).mean() < 0.05
    assert seen.rewards.max() > 0.5


def test_the_camera_sees_each_episodes_own_target() -> None:
    env = make_env(layout_of("square"), 8, pixels=64)
    generators = evaluation_generators(8)
    for _ in range(3):
        env.reset(generators)
        result = env.step(near_goals(env))
        assert result.camera_rewards is not None
        assert np.abs(result.camera_rewards - result.rewards).max() < 0.2


def test_physics_and_kinematic_play_the_same_episodes() -> None:
    layout = layout_of(*TRIO)
    envs = [
        begun(make_env(layout, 4, backend=backend, actions_per_token=2))
        for backend in ("physics", "kinematic")
    ]
    rng = np.random.default_rng(0)
    for _ in range(envs[0].horizon):
        actions = rng.uniform(-1.0, 1.0, (4, 4))
        results = [env.step(actions) for env in envs]
        np.testing.assert_allclose(envs[0].corners, envs[1].corners, atol=1e-9)
        np.testing.assert_array_equal(envs[0].placed, envs[1].placed)
        np.testing.assert_array_equal(results[0].refused, results[1].refused)
        np.testing.assert_allclose(results[0].rewards, results[1].rewards, atol=1e-7)
    envs[0].close()


@pytest.mark.parametrize("actions_per_token", [1, 3])
def test_no_corner_leaves_the_bound(actions_per_token: int) -> None:
    layout = layout_of("square")
    env = make_env(layout, 256, actions_per_token=actions_per_token)
    largest = 0.0
    for _ in range(4):
        begun(env)
        away = np.sign(layout.poses(env.corners)[:, 0])
        for _ in range(env.horizon):
            env.step(away)
        largest = max(largest, float(np.abs(env.corners).max()))
    assert 0.9 * env.bound < largest <= env.bound


def test_actions_beyond_the_box_count_as_its_bound() -> None:
    envs = [begun(make_env(layout_of("square"))) for _ in range(2)]
    envs[0].step(np.full((4, 3), 7.0))
    envs[1].step(np.full((4, 3), 1.0))
    np.testing.assert_array_equal(envs[0].corners, envs[1].corners)


def test_single_precision_actions_are_welcome() -> None:
    env = begun(make_env(PAIR))
    env.step(np.full((4, 4), 0.25, dtype=np.float32))  # type: ignore[arg-type]
    assert env.corners.dtype == np.float64


@pytest.mark.parametrize(
    ("actions", "reason"),
    [
        (np.zeros((4, 4)), r"shape \(4, 3\), got \(4, 4\)"),
        (np.zeros((3, 3)), r"shape \(4, 3\), got \(3, 3\)"),
        (np.full((4, 3), np.nan), "finite"),
        (np.full((4, 3), np.inf), "finite"),
    ],
)
def test_refused_actions(actions: Floats, reason: str) -> None:
    env = begun(make_env(layout_of("square")))
    with pytest.raises(ValueError, match=reason):
        env.step(actions)
    assert env.steps_done == 0


def test_an_episode_has_to_begin_and_ends() -> None:
    env = make_env(layout_of("square"))
    with pytest.raises(RuntimeError, match="call reset first"):
        env.step(np.zeros((4, 3)))
    begun(env).step(np.zeros((4, 3)))
    with pytest.raises(RuntimeError, match="episode of 1 steps is over"):
        env.step(np.zeros((4, 3)))


def test_refused_constructions() -> None:
    with pytest.raises(ValueError, match="need 4 generators, got 3"):
        make_env(layout_of("square")).reset(evaluation_generators(3))
    with pytest.raises(ValueError, match="at least 1, got 0"):
        make_env(layout_of("square"), 0)
    with pytest.raises(ConfigError, match=r"set sim\.pixels=64"):
        make_env(layout_of("square"), source="camera")
