"""Episodes of many environments in step: what moves, what is refused or blocked, what is paid."""

from typing import Any

import numpy as np
import pytest

from tangram_sim.actions import chosen_tokens, velocities
from tangram_sim.arrays import Floats
from tangram_sim.batch import BatchedEnv, StepResult
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.env import TangramEnv
from tangram_sim.errors import ConfigError
from tangram_sim.geometry import overlap_share
from tangram_sim.layout import Layout
from tangram_sim.sampling import sample_batch
from tangram_sim.seeding import evaluation_generators
from tests.sim.builders import SEVEN, TRIO, largest_overlap, layout_of

pytestmark = pytest.mark.fast

PAIR = layout_of("square", "small_triangle")


BOTH = pytest.mark.parametrize("backend", ["physics", "kinematic"])


def make_env(
    layout: Layout, count: int = 4, reward: str = "overlap", source: str = "polygon", **sim: Any
) -> BatchedEnv:
    config = SimConfig(**{"backend": "kinematic", **sim})
    return BatchedEnv(layout, config, RewardConfig(reward, source), count)


def begun(layout: Layout, count: int = 4, **settings: Any) -> BatchedEnv:
    env = make_env(layout, count, **settings)
    env.reset(evaluation_generators(count))
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


@BOTH
@pytest.mark.parametrize("arena", [2.0, 0.7])
def test_every_pose_is_reached_in_one_action(backend: str, arena: float) -> None:
    layout = layout_of("square", scale=0.5 * arena)
    env = begun(layout, 16, backend=backend, arena=arena)
    motion = (layout.poses(env.goals) - layout.poses(env.corners))[:, 0]
    motion[:, 2] = np.angle(np.exp(1j * motion[:, 2]))
    actions = motion / [arena, arena, np.pi]
    assert np.abs(actions).max() <= 1.0
    result = env.step(actions)
    np.testing.assert_allclose([result.overlap, result.rewards], 1.0, atol=1e-6)
    assert result.done
    env.close()


def test_shapes_and_sizes() -> None:
    env = begun(layout_of(*SEVEN, scale=0.6), 5, actions_per_token=2)
    assert (env.horizon, env.action_size) == (14, 4)
    assert env.corners.shape == env.goals.shape == (5, 23, 2)
    assert env.placed.shape == (5, 7)
    assert not env.placed.any()
    assert make_env(layout_of("square"), actions_per_token=3).action_size == 3


def test_an_episode_of_two_tokens() -> None:
    """One environment each: both tokens, the same token twice, the second first."""
    env = begun(PAIR, 3)
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
    env = begun(PAIR, 1, actions_per_token=2)
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


def test_each_episode_begins_anew_and_comes_from_the_generators() -> None:
    env, generators = begun(PAIR), evaluation_generators(4)
    targets, starts = (PAIR.corners(sample_batch(PAIR, env.sim, generators)) for _ in range(2))
    assert np.abs(starts - targets).max() > 0.1
    for _ in range(2):
        assert env.steps_done == 0
        assert not env.placed.any()
        np.testing.assert_allclose(env.goals, targets)
        np.testing.assert_allclose(env.corners, starts)
        for _ in range(env.horizon):
            env.step(np.full((4, 4), -1.0))
        env.reset(evaluation_generators(4))


@pytest.mark.parametrize("reward", ["overlap", "dense", "pose"])
def test_rewards_are_those_of_the_reward_function(reward: str) -> None:
    env = begun(layout_of(*TRIO), 16, reward=reward)
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


@BOTH
def test_camera_reports_and_pays_by_each_episodes_own_target(backend: str) -> None:
    layout, generators = layout_of("square"), [evaluation_generators(8) for _ in range(2)]
    envs = [
        make_env(layout, 8, source=source, backend=backend, camera=True)
        for source in ("polygon", "camera")
    ]
    for _ in range(2):
        results = []
        for env, own in zip(envs, generators, strict=True):
            env.reset(own)
            results.append(env.step(near_goals(env)))
        exact, seen = results
        assert exact.camera_rewards is not None
        np.testing.assert_array_equal(exact.camera_rewards, seen.camera_rewards)
        np.testing.assert_array_equal(seen.rewards, seen.camera_rewards)
        assert 1e-6 < np.abs(seen.rewards - exact.rewards).max() < 0.2
        assert np.abs(seen.rewards - exact.rewards).mean() < 0.05
        assert seen.rewards.max() > 0.5
    for env in envs:
        env.close()


def test_physics_and_kinematic_play_the_same_episodes() -> None:
    layout = layout_of(*TRIO)
    envs = [begun(layout, backend=name, actions_per_token=2) for name in ("physics", "kinematic")]
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
    env = begun(layout_of("square"), 1000, actions_per_token=actions_per_token)
    away = np.sign(env.layout.poses(env.corners)[:, 0])
    for _ in range(env.horizon):
        env.step(away)
    assert 0.9 * env.bound < np.abs(env.corners).max() <= env.bound


def test_actions_beyond_the_box_count_as_its_bound_in_either_precision() -> None:
    envs = [begun(layout_of("square")) for _ in range(2)]
    envs[0].step(np.full((4, 3), 7.0, dtype=np.float32))  # type: ignore[arg-type]
    envs[1].step(np.full((4, 3), 1.0))
    np.testing.assert_array_equal(envs[0].corners, envs[1].corners)
    assert envs[0].corners.dtype == np.float64


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
    env = begun(layout_of("square"))
    with pytest.raises(ValueError, match=reason):
        env.step(actions)
    assert env.steps_done == 0


def test_an_episode_has_to_begin_and_ends() -> None:
    env = make_env(layout_of("square"))
    with pytest.raises(RuntimeError, match="call reset first"):
        env.step(np.zeros((4, 3)))
    env.reset(evaluation_generators(4))
    env.step(np.zeros((4, 3)))
    with pytest.raises(RuntimeError, match="episode of 1 steps is over"):
        env.step(np.zeros((4, 3)))


def test_refused_constructions() -> None:
    with pytest.raises(ValueError, match="need 4 generators, got 3"):
        make_env(layout_of("square")).reset(evaluation_generators(3))
    with pytest.raises(ValueError, match="at least 1, got 0"):
        make_env(layout_of("square"), 0)
    with pytest.raises(ConfigError, match=r"sim\.camera=true"):
        make_env(layout_of("square"), source="camera")


# Placements on others: how much is allowed, what a refused one costs, and what stays.

SQUARES = layout_of("square", "square", scale=2.0**0.5)  # sides of 0.5
TRIPLE = layout_of("square", "square", "square", scale=2.0**0.5)
SIDE = 0.5


def lie(env: BatchedEnv, starts: Floats) -> BatchedEnv:
    """The environments with their tokens where they are told (B, K, 3)."""
    for world, poses in zip(env._worlds, starts, strict=True):
        world.place(poses)
    env._look()
    return env


def lying(layout: Layout, starts: Floats, **sim: Any) -> BatchedEnv:
    return lie(begun(layout, len(starts), **{"arena": 4.0, **sim}), starts)


def put_first_at(env: BatchedEnv, x: Floats) -> StepResult:
    """Move token 0 of each environment to (x, 0)."""
    here = env.layout.poses(env.corners)[:, 0, 0]
    actions = np.zeros((env.count, 4))
    actions[:, 0], actions[:, 1] = -1.0, (x - here) / env.sim.arena
    return env.step(actions)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
@BOTH
def test_the_bound_is_exact(share: float, backend: str) -> None:
    """Squares side by side: what is shared is as wide as the way that is too short."""
    starts = np.tile([[-1.5, 0.0, 0.0], [0.0, 0.0, 0.0]], (3, 1, 1))
    env = lying(SQUARES, starts, max_overlap=share, backend=backend)
    off = 1e-4 if share < 1.0 else 0.0
    wanted = np.array([share - off, share, share + off])
    before = env.corners.copy()
    result = put_first_at(env, -SIDE * (1.0 - wanted) + np.array([0.0, -1e-9, 0.0]))
    np.testing.assert_allclose(result.covered, np.maximum(wanted, 0.0), atol=1e-6)
    assert result.blocked.tolist() == [False, False, share < 1.0]
    assert not result.refused.any()
    moved = np.abs(env.corners - before).max(axis=(1, 2)) > 0.5
    np.testing.assert_array_equal(moved, ~result.blocked)
    assert env.placed.tolist() == [[True, False]] * 3
    env.close()


def test_a_blocked_action_is_one_of_the_tokens() -> None:
    starts = np.array([[[-1.5, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    env = lying(SQUARES, starts, actions_per_token=2)
    before = env.corners.copy()
    flags = []
    for x in (-0.1, -0.2, -1.0, -0.1):  # a placed token is refused and not blocked
        result = put_first_at(env, np.array([x]))
        flags.append((bool(result.blocked[0]), bool(result.refused[0]), env.placed[0].tolist()))
    assert flags == [
        (True, False, [False, False]),
        (True, False, [True, False]),
        (False, True, [True, False]),
        (False, True, [True, False]),
    ]
    np.testing.assert_array_equal(env.corners, before)


def test_what_lies_on_several_tokens_adds_up() -> None:
    """Between two tokens, on each by 0.15 of its area: each alone would be allowed."""
    gap = SIDE * 0.7
    starts = np.zeros((2, 3, 3))
    starts[:, 0, 1] = 1.5
    starts[:, 1, 0], starts[:, 2, 0] = -(gap + SIDE) / 2.0, (gap + SIDE) / 2.0
    starts[1, 2, 0] += 0.15 * SIDE
    env = lying(TRIPLE, starts)
    actions = np.tile([-1.0, 0.0, -1.5 / 4.0, 0.0], (2, 1))
    result = env.step(actions)
    np.testing.assert_allclose(result.covered, [0.3, 0.15], atol=1e-9)
    assert result.blocked.tolist() == [True, False]


def test_another_tokens_overlap_does_not_count() -> None:
    """Token 1 lies on token 2 already; token 0 is set down beside them."""
    starts = np.array([[[-1.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.6, 0.1, 0.2]]])
    result = put_first_at(lying(TRIPLE, starts), np.array([-0.5]))
    assert (result.covered[0], bool(result.blocked[0])) == (0.0, False)


def test_the_side_that_it_would_lie_on_counts() -> None:
    layout = layout_of("parallelogram", "square", scale=1.0)
    corner = np.array([0.375, 0.125]) + layout.shapes[1].radius * 0.5
    starts = np.tile([[0.0, 0.0, 0.0], [corner[0], -corner[1], 0.0]], (2, 1, 1))
    env = lying(layout, starts, arena=2.0, max_overlap=0.0, allow_flip=True)
    result = env.step(np.array([[-1.0, flip, 0.0, 0.0, 0.0] for flip in (-1.0, 1.0)]))
    assert result.covered[0] == 0.0
    assert result.covered[1] > 0.0
    assert result.blocked.tolist() == [False, True]


def test_blocked_alike_in_both_worlds() -> None:
    """Until a placement that overlaps, which only the engine settles."""
    layout, rng = layout_of(*SEVEN, scale=0.6), np.random.default_rng(0)
    envs = [begun(layout, 16, backend=name, max_overlap=0.0) for name in ("physics", "kinematic")]
    blocked = 0
    for _ in range(7):
        actions = rng.uniform(-0.6, 0.6, (16, 4))
        one, two = (env.step(actions) for env in envs)
        np.testing.assert_array_equal(one.blocked, two.blocked)
        np.testing.assert_allclose(one.covered, two.covered, atol=1e-6)
        np.testing.assert_allclose(envs[0].corners, envs[1].corners, atol=1e-6)
        blocked += int(one.blocked.sum())
    assert blocked > 5
    envs[0].close()


def test_an_episode_of_the_game_ends_without_overlaps() -> None:
    layout, rng = layout_of(*SEVEN, scale=0.6), np.random.default_rng(0)
    env = begun(layout, 12, backend="physics", starts="outside")
    for token in range(7):
        actions = rng.uniform(-0.4, 0.4, (12, 4))
        actions[:, 0] = (token + 0.5) / 3.5 - 1.0
        env.step(actions)
    assert max(largest_overlap(layout, poses) for poses in layout.poses(env.corners)) < 1e-5
    assert np.abs(env.corners).max() <= env.bound
    env.close()


def test_the_gymnasium_environment_tells_why() -> None:
    env = TangramEnv(("square", "square"), 2.0**0.5, backend="kinematic", arena=4.0)
    env.reset(seed=0)
    lie(env.batch, np.array([[[-1.5, 0.0, 0.0], [0.0, 0.0, 0.0]]]))
    *_, info = env.step(np.array([-1.0, (1.5 - 0.73 * SIDE) / 4.0, 0.0, 0.0], dtype=np.float32))
    assert info["blocked"].startswith(
        "token 0 would lie on others by 27.000% of its area, at most 20.000% allowed: set it down"
    )
    assert "refused" not in info
    *_, info = env.step(np.array([1.0, 0.1, 0.0, 0.0], dtype=np.float32))
    assert "blocked" not in info
