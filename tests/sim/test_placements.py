"""Placements on others: how much is allowed, what a refused one costs, and what stays."""

from typing import Any

import numpy as np
import pytest

from tangram_sim.arrays import Floats
from tangram_sim.batch import BatchedEnv, StepResult
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.env import TangramEnv
from tangram_sim.layout import Layout
from tangram_sim.seeding import evaluation_generators
from tests.sim.builders import SEVEN, largest_overlap, layout_of

pytestmark = pytest.mark.fast

PAIR = layout_of("square", "square", scale=2.0**0.5)  # sides of 0.5
TRIPLE = layout_of("square", "square", "square", scale=2.0**0.5)
SIDE = 0.5


def begun(layout: Layout, starts: Floats, **sim: Any) -> BatchedEnv:
    """Environments whose tokens lie where they are told (B, K, 3)."""
    config = SimConfig(**{"backend": "kinematic", "arena": 4.0, **sim})
    env = BatchedEnv(layout, config, RewardConfig(), len(starts))
    env.reset(evaluation_generators(len(starts)))
    for world, poses in zip(env._worlds, starts, strict=True):
        world.place(poses)
    env._look()
    return env


def put_first_at(env: BatchedEnv, x: Floats) -> StepResult:
    """Move token 0 of each environment to (x, 0)."""
    here = env.layout.poses(env.corners)[:, 0, 0]
    actions = np.zeros((env.count, 4))
    actions[:, 0], actions[:, 1] = -1.0, (x - here) / env.sim.arena
    return env.step(actions)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
@pytest.mark.parametrize("backend", ["physics", "kinematic"])
def test_the_bound_is_exact(share: float, backend: str) -> None:
    """Squares side by side: what is shared is as wide as the way that is too short."""
    starts = np.tile([[-1.5, 0.0, 0.0], [0.0, 0.0, 0.0]], (3, 1, 1))
    env = begun(PAIR, starts, max_overlap=share, backend=backend)
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
    env = begun(PAIR, starts, actions_per_token=2)
    before = env.corners.copy()
    flags = []
    for x in (-0.1, -0.2, -1.0, -1.0):
        result = put_first_at(env, np.array([x]))
        flags.append((bool(result.blocked[0]), bool(result.refused[0]), env.placed[0].tolist()))
    assert flags == [
        (True, False, [False, False]),
        (True, False, [True, False]),
        (False, True, [True, False]),
        (False, True, [True, False]),
    ]
    np.testing.assert_array_equal(env.corners, before)


def test_a_placed_token_is_refused_and_not_blocked() -> None:
    env = begun(PAIR, np.array([[[-1.5, 0.0, 0.0], [0.0, 0.0, 0.0]]]))
    put_first_at(env, np.array([-1.0]))
    result = put_first_at(env, np.array([-0.1]))
    assert (result.refused[0], result.blocked[0]) == (True, False)


def test_what_lies_on_several_tokens_adds_up() -> None:
    """Between two tokens, on each by 0.15 of its area: each alone would be allowed."""
    gap = SIDE * 0.7
    starts = np.zeros((2, 3, 3))
    starts[:, 0, 1] = 1.5
    starts[:, 1, 0], starts[:, 2, 0] = -(gap + SIDE) / 2.0, (gap + SIDE) / 2.0
    starts[1, 2, 0] += 0.15 * SIDE
    env = begun(TRIPLE, starts)
    actions = np.tile([-1.0, 0.0, -1.5 / 4.0, 0.0], (2, 1))
    result = env.step(actions)
    np.testing.assert_allclose(result.covered, [0.3, 0.15], atol=1e-9)
    assert result.blocked.tolist() == [True, False]


def test_another_tokens_overlap_does_not_count() -> None:
    """Token 1 lies on token 2 already; token 0 is set down beside them."""
    starts = np.array([[[-1.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.6, 0.1, 0.2]]])
    result = put_first_at(begun(TRIPLE, starts), np.array([-0.5]))
    assert (result.covered[0], bool(result.blocked[0])) == (0.0, False)


def test_the_side_that_it_would_lie_on_counts() -> None:
    layout = layout_of("parallelogram", "square", scale=1.0)
    config = SimConfig(backend="kinematic", max_overlap=0.0, allow_flip=True)
    env = BatchedEnv(layout, config, RewardConfig(), 2)
    env.reset(evaluation_generators(2))
    corner = np.array([0.375, 0.125]) + layout.shapes[1].radius * 0.5
    for world in env._worlds:
        world.place(np.array([[0.0, 0.0, 0.0], [*corner * [1.0, -1.0], 0.0]]))
    env._look()
    result = env.step(np.array([[-1.0, flip, 0.0, 0.0, 0.0] for flip in (-1.0, 1.0)]))
    assert result.covered[0] == 0.0
    assert result.covered[1] > 0.0
    assert result.blocked.tolist() == [False, True]


def test_blocked_alike_in_both_worlds() -> None:
    """Until a placement that overlaps, which only the engine settles."""
    layout = layout_of(*SEVEN, scale=0.6)
    rng, blocked = np.random.default_rng(0), 0
    for seed in range(4):
        sims = [SimConfig(backend=name, max_overlap=0.0) for name in ("physics", "kinematic")]
        envs = [BatchedEnv(layout, sim, RewardConfig(), 4) for sim in sims]
        for env in envs:
            env.reset([np.random.default_rng([seed, b]) for b in range(4)])
        for _ in range(7):
            actions = rng.uniform(-0.6, 0.6, (4, 4))
            one, two = (env.step(actions) for env in envs)
            np.testing.assert_array_equal(one.blocked, two.blocked)
            np.testing.assert_allclose(one.covered, two.covered, atol=1e-6)
            np.testing.assert_allclose(envs[0].corners, envs[1].corners, atol=1e-6)
            blocked += int(one.blocked.sum())
        envs[0].close()
    assert blocked > 5


def test_an_episode_of_the_game_ends_without_overlaps() -> None:
    layout, rng = layout_of(*SEVEN, scale=0.6), np.random.default_rng(0)
    env = BatchedEnv(layout, SimConfig(starts="outside"), RewardConfig(), 8)
    for _ in range(2):
        env.reset([np.random.default_rng([1, b]) for b in range(8)])
        for token in range(7):
            actions = rng.uniform(-0.4, 0.4, (8, 4))
            actions[:, 0] = (token + 0.5) / 3.5 - 1.0
            env.step(actions)
        for poses in layout.poses(env.corners):
            assert largest_overlap(layout, poses) < 1e-5
        assert np.abs(env.corners).max() <= env.bound
    env.close()


def test_the_gymnasium_environment_tells_why() -> None:
    env = TangramEnv(("square", "square"), 2.0**0.5, backend="kinematic", arena=4.0)
    env.reset(seed=0)
    env.batch._worlds[0].place(np.array([[-1.5, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    env.batch._look()
    *_, info = env.step(np.array([-1.0, (1.5 - 0.73 * SIDE) / 4.0, 0.0, 0.0], dtype=np.float32))
    assert info["blocked"].startswith(
        "token 0 would lie on others by 27.000% of its area, at most 20.000% allowed: set it down"
    )
    assert "refused" not in info
    *_, info = env.step(np.array([1.0, 0.1, 0.0, 0.0], dtype=np.float32))
    assert "blocked" not in info
