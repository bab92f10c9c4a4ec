"""Episodes of many environments in step: what moves, what is refused or blocked, what is paid."""

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.batch import BatchedEnv, StepResult
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout, TokensConfig
from tangram_sim.motion.actions import chosen_tokens, velocities
from tangram_tasks.place import Place
from tests.sim.builders import SEVEN, evaluation_generators, layout_of

pytestmark = pytest.mark.fast

PAIR = layout_of("square", "small_triangle")
SQUARE = layout_of("square")
GAME = layout_of(*SEVEN, scale=0.6)
BOTH = pytest.mark.parametrize("backend", ["physics", "kinematic"])


def made(
    layout: Layout, count: int = 4, reward: str = "overlap", source: str = "polygon", **sim: Any
) -> BatchedEnv:
    config = SimConfig(**{"backend": "kinematic", **sim})
    return BatchedEnv(layout, config, RewardConfig(reward, source), count)


def begun(layout: Layout, count: int = 4, **settings: Any) -> BatchedEnv:
    env = made(layout, count, **settings)
    env.reset(evaluation_generators(count))
    return env


def onto(env: BatchedEnv, deviation: float = 0.0) -> Floats:
    """Actions that move each environment's only token onto its target, or about so."""
    motion = (env.layout.poses(env.goals) - env.layout.poses(env.corners))[:, 0]
    motion[:, 2] = np.angle(np.exp(1j * motion[:, 2]))
    noise = np.random.default_rng(0).normal(0.0, 1.0, motion.shape)
    actions: Floats = (motion + deviation * noise) / [env.sim.arena, env.sim.arena, np.pi]
    return actions


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
    env = begun(layout_of("square", scale=0.5 * arena), 16, backend=backend, arena=arena)
    actions = onto(env)
    assert np.abs(actions).max() <= 1.0
    result = env.step(actions)
    np.testing.assert_allclose([result.coverage, result.rewards], 1.0, atol=1e-6)
    assert result.done
    env.close()


ONE, TWO, NONE = [1] * 4 + [0] * 3, [0] * 4 + [1] * 3, [0] * 7


def test_an_episode_of_two_tokens() -> None:
    """One environment each: both tokens, the same token twice, the second first."""
    env = begun(PAIR, 3)
    for axis, chosen, refused, placed, moved in (
        (0, [-1, -1, 1], [0, 0, 0], [[1, 0], [1, 0], [0, 1]], [ONE, ONE, TWO]),
        (1, [1, -1, -1], [0, 1, 0], [[1, 1], [1, 0], [1, 1]], [TWO, NONE, ONE]),
    ):
        before, actions = env.corners, np.zeros((3, 4))
        actions[:, 0], actions[:, 1 + axis] = chosen, 0.1
        result = env.step(actions)
        assert (result.done, result.refused.tolist()) == (axis == 1, refused)
        assert env.placed.tolist() == placed
        np.testing.assert_allclose((env.corners - before)[..., axis] / 0.2, moved, atol=1e-9)


@BOTH
def test_camera_reports_and_pays_by_each_episodes_own_target(backend: str) -> None:
    sources, generators = ("polygon", "camera"), [evaluation_generators(8) for _ in range(2)]
    envs = [made(SQUARE, 8, source=one, backend=backend, pixels=64) for one in sources]
    for _ in range(2):
        results = []
        for env, own in zip(envs, generators, strict=True):
            env.reset(own)
            results.append(env.step(onto(env, 0.1)))
        exact, seen = results
        assert exact.camera_rewards is not None
        np.testing.assert_array_equal(exact.camera_rewards, seen.camera_rewards)
        np.testing.assert_array_equal(seen.rewards, seen.camera_rewards)
        assert 1e-6 < np.abs(seen.rewards - exact.rewards).max() < 0.2
        assert np.abs(seen.rewards - exact.rewards).mean() < 0.05
        assert seen.rewards.max() > 0.5
    for env in envs:
        env.close()


@pytest.mark.parametrize("actions_per_token", [1, 3])
def test_no_corner_leaves_the_bound(actions_per_token: int) -> None:
    env = begun(SQUARE, 1000, actions_per_token=actions_per_token)
    away = np.sign(env.layout.poses(env.corners)[:, 0])
    for _ in range(env.horizon):
        env.step(away)
    bound = env.spec.field("corners").high
    assert 0.9 * bound < np.abs(env.corners).max() <= bound


def test_actions_beyond_the_box_count_as_its_bound_in_either_precision() -> None:
    envs = [begun(SQUARE) for _ in range(2)]
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
    env = begun(SQUARE)
    with pytest.raises(ValueError, match=reason):
        env.step(actions)
    assert env.steps_done == 0


def test_an_episode_has_to_begin_and_ends() -> None:
    env, still = made(SQUARE), np.zeros((4, 3))
    with pytest.raises(RuntimeError, match="call reset first"):
        env.step(still)
    with pytest.raises(ValueError, match="need 4 generators, got 3"):
        env.reset(evaluation_generators(3))
    env.reset(evaluation_generators(4))
    env.step(still)
    with pytest.raises(RuntimeError, match="episode of 1 steps is over"):
        env.step(still)


def test_refused_constructions() -> None:
    with pytest.raises(ValueError, match="at least 1, got 0"):
        made(SQUARE, 0)
    with pytest.raises(ConfigError, match=r"set sim\.pixels=64"):
        made(SQUARE, source="camera")


# Placements on others: how much is allowed, what a refused one costs, and what stays.

SQUARES = layout_of("square", "square", scale=2.0**0.5)  # sides of 0.5
TRIPLE = layout_of("square", "square", "square", scale=2.0**0.5)
SIDE, BESIDE = 0.5, [[-1.5, 0.0, 0.0], [0.0, 0.0, 0.0]]


def lie(env: BatchedEnv, starts: Any) -> BatchedEnv:
    """The environments with their tokens where they are told (B, K, 3)."""
    for world, poses in zip(env._worlds, np.array(starts), strict=True):
        world.place(poses)
    env._look()
    return env


def lying(layout: Layout, starts: Any, **sim: Any) -> BatchedEnv:
    return lie(begun(layout, len(starts), **{"arena": 4.0, **sim}), starts)


def put_first_at(env: BatchedEnv, *places: float) -> StepResult:
    """Move token 0 of each environment to (x, 0)."""
    way = np.array([(x, 0.0) for x in places]) - env.layout.poses(env.corners)[:, 0, :2]
    return env.step(np.insert(way / env.sim.arena, [0, 2], [-1.0, 0.0], axis=1))


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
@BOTH
def test_the_bound_is_exact(share: float, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Squares side by side: what is shared is as wide as the way that is too short."""
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", share)
    env = lying(SQUARES, [BESIDE] * 3, backend=backend)
    off = 1e-4 if share < 1.0 else 0.0
    wanted, before = np.array([share - off, share, share + off]), env.corners
    result = put_first_at(env, *(SIDE * (wanted - 1.0) - [0.0, 1e-9, 0.0]))
    np.testing.assert_allclose(result.covered, np.maximum(wanted, 0.0), atol=1e-6)
    assert result.blocked.tolist() == [False, False, share < 1.0]
    assert not result.refused.any()
    moved = np.abs(env.corners - before).max(axis=(1, 2)) > 0.5
    np.testing.assert_array_equal(moved, ~result.blocked)
    assert env.placed.tolist() == [[True, False]] * 3
    env.close()


def test_a_blocked_action_is_one_of_the_tokens_and_a_refused_one_is_not_blocked() -> None:
    env = lying(SQUARES, [BESIDE], actions_per_token=2)
    before, flags = env.corners, []
    for x in (-0.1, -0.2, -1.0, -0.1):
        result = put_first_at(env, x)
        flags.append((result.blocked[0], result.refused[0], env.placed[0, 0]))
    assert flags == [(True, False, False), (True, False, True), *[(False, True, True)] * 2]
    np.testing.assert_array_equal(env.corners, before)


GAP = 0.35  # between two tokens, on which a third lies by 0.15 of its area each


@pytest.mark.parametrize(
    ("starts", "covered"),
    [
        ([[0, 1.5, 0], [-(GAP + SIDE) / 2, 0, 0], [(GAP + SIDE) / 2, 0, 0]], 0.3),  # adds up
        ([[0, 1.5, 0], [-(GAP + SIDE) / 2, 0, 0], [(GAP + SIDE) / 2 + 0.075, 0, 0]], 0.15),
        ([[-1.5, 0, 0], [1.0, 0, 0], [1.1, 0.1, 0.2]], 0.0),  # others on each other do not count
    ],
)
def test_what_lies_on_several_tokens_adds_up(starts: list[list[float]], covered: float) -> None:
    result = put_first_at(lying(TRIPLE, [starts]), 0.0)
    np.testing.assert_allclose(result.covered, [covered], atol=1e-9)
    assert result.blocked.tolist() == [covered > 0.2]


def test_the_side_that_it_would_lie_on_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 0.0)
    layout = layout_of("parallelogram", "square", scale=1.0)
    corner = np.array([0.375, 0.125]) + layout.shapes[1].radius * 0.5
    starts = [[[0.0, 0.0, 0.0], [corner[0], -corner[1], 0.0]]] * 2
    env = lying(layout, starts, arena=2.0, allow_flip=True)
    result = env.step(np.array([[-1.0, flip, 0.0, 0.0, 0.0] for flip in (-1.0, 1.0)]))
    assert (result.covered > 0.0).tolist() == result.blocked.tolist() == [False, True]


def test_both_worlds_play_the_same_episodes_while_no_overlap_is_allowed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 0.0)
    rng, blocked, refused = np.random.default_rng(0), 0, 0
    envs = [begun(GAME, 12, backend=name, actions_per_token=2) for name in ("physics", "kinematic")]
    for _ in range(10):
        actions = rng.uniform(-0.6, 0.6, (12, 4))
        one, two = (env.step(actions) for env in envs)
        np.testing.assert_array_equal(one.blocked, two.blocked)
        np.testing.assert_array_equal(one.refused, two.refused)
        np.testing.assert_array_equal(envs[0].placed, envs[1].placed)
        np.testing.assert_allclose(one.covered, two.covered, atol=1e-6)
        np.testing.assert_allclose(one.rewards, two.rewards, atol=1e-6)
        np.testing.assert_allclose(envs[0].corners, envs[1].corners, atol=1e-6)
        blocked, refused = blocked + one.blocked.sum(), refused + one.refused.sum()
    assert min(blocked, refused) > 5
    envs[0].close()


def test_a_task_tells_why_nothing_moved() -> None:
    world = SimConfig(backend="kinematic", arena=4.0)
    task = Place(TokensConfig(("square", "square"), 2.0**0.5), world, RewardConfig())
    with closing(task.make(1)) as env:
        env.reset([np.random.default_rng(0)])
        lie(env.world, [BESIDE])
        env.step(np.array([[-1.0, (1.5 - 0.73 * SIDE) / 4.0, 0.0, 0.0]], np.float32))
        assert env.told()["refused"].startswith(
            "token 0 would lie on others by 27.000% of its area, at most 20.000% allowed: set it d"
        )
        env.step(np.array([[1.0, 0.1, 0.0, 0.0]], np.float32))
        assert env.told().keys() == {"coverage", "is_success"}
