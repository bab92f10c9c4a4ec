"""Noise on the corners that agents see, and nowhere else."""

import numpy as np
import pytest

from tangram_core.seeding import evaluation_generators
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.env import TangramEnv
from tangram_sim.rewards import make_reward
from tangram_sim.sight.observation_noise import noise_bound, see
from tests.sim.builders import TRIO, layout_of

pytestmark = pytest.mark.fast

NOISY = SimConfig(backend="kinematic", corner_noise=0.02)
LAYOUT = layout_of("square", scale=1.0)


def generators(count: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, i]) for i in range(count)]


def test_without_noise_nothing_is_drawn_or_copied() -> None:
    corners, made = np.ones((2, 4, 2)), generators(2)
    assert see(corners, SimConfig(), made) is corners
    assert made[0].random() == generators(2)[0].random()


def test_noise_is_gaussian_with_the_deviation_asked_for_and_cut_at_its_bound() -> None:
    sim = SimConfig(arena=3.0, corner_noise=0.02)
    noise = see(np.zeros((5, 40_000, 2)), sim, generators(5))
    assert noise.mean() == pytest.approx(0.0, abs=0.001)
    assert noise.std() == pytest.approx(0.06, rel=0.02)
    # one in 44 normal numbers lies beyond two deviations on each side
    assert np.mean(noise > 0.12) == pytest.approx(0.0228, abs=0.002)
    assert np.abs(noise).max() == noise_bound(sim) == pytest.approx(4 * 0.06)


def test_each_environment_has_noise_of_its_own() -> None:
    together = see(np.zeros((3, 4, 2)), NOISY, generators(3))
    np.testing.assert_array_equal(together[2:], see(np.zeros((1, 4, 2)), NOISY, generators(3)[2:]))


def played(sim: SimConfig) -> BatchedEnv:
    env = BatchedEnv(LAYOUT, sim, RewardConfig(), 4)
    env.reset(evaluation_generators(4))
    return env


def test_noise_changes_what_is_seen_and_nothing_else() -> None:
    noisy, exact = played(NOISY), played(SimConfig(backend="kinematic"))
    np.testing.assert_array_equal(noisy.corners, exact.corners)
    np.testing.assert_array_equal(noisy.goals, exact.goals)
    actions = np.full((4, 3), 0.1)
    ours, theirs = noisy.step(actions), exact.step(actions)
    np.testing.assert_array_equal(noisy.corners, exact.corners)
    np.testing.assert_allclose(ours.overlap, theirs.overlap)
    np.testing.assert_allclose(ours.rewards, theirs.rewards)
    for seen, corners in ((noisy.seen, noisy.corners), (noisy.seen_goals, noisy.goals)):
        assert 0.0 < np.abs(seen - corners).max() <= noise_bound(NOISY)
    assert exact.seen is exact.corners
    assert exact.seen_goals is exact.goals


def test_noise_is_new_at_every_step_within_the_bound_and_one_for_the_target() -> None:
    env = played(SimConfig(backend="kinematic", corner_noise=0.2, actions_per_token=2))
    first, goals = env.seen - env.corners, env.seen_goals.copy()
    env.step(np.ones((4, 3)))
    assert not np.allclose(env.seen - env.corners, first)
    assert np.abs(env.seen).max() <= env.bound
    np.testing.assert_array_equal(env.seen_goals, goals)


@pytest.mark.parametrize("name", ["overlap", "dense"])
def test_noisy_corners_are_rewarded_as_the_rigid_pieces_that_fit(name: str) -> None:
    layout, generator = layout_of(*TRIO), np.random.default_rng(0)
    poses = generator.uniform(-1.0, 1.0, (50, 3, 3))
    corners = layout.corners(poses)
    noisy = corners + 0.1 * generator.standard_normal(corners.shape)
    exact = make_reward(RewardConfig(name), layout, SimConfig())
    reward = make_reward(RewardConfig(name), layout, SimConfig(corner_noise=0.05))
    fitted = layout.corners(layout.poses(noisy))
    np.testing.assert_allclose(reward(noisy, corners), exact(fitted, corners))
    # exact corners fit themselves
    np.testing.assert_allclose(reward(corners, corners), 1.0)


def test_the_environment_shows_noisy_corners() -> None:
    env = TangramEnv(backend="kinematic", corner_noise=0.05)
    observation, _ = env.reset(seed=3)
    assert not np.allclose(observation["achieved_goal"], env.batch.corners[0].ravel(), atol=1e-3)
    assert env.observation_space.contains(observation)
    reward = env.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
    assert -1.0 <= reward <= 1.0
