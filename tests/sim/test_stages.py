"""A curriculum: which stage is played when, and what is done already in one with fewer tokens."""

from dataclasses import replace

import numpy as np
import pytest

from tangram_sim.arrays import Bools
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig, StageConfig
from tangram_sim.layout import Layout
from tangram_sim.seeding import evaluation_generators
from tests.sim.builders import SEVEN, largest_overlap, layout_of

pytestmark = pytest.mark.fast

GAME = layout_of(*SEVEN, scale=0.6)
STAGES = (
    StageConfig(updates=10, tokens=1),
    StageConfig(updates=50, tokens=3, targets="gaussian", spread=0.3),
)


@pytest.mark.parametrize(
    ("updates", "stage"), [(0, 0), (9, 0), (10, 1), (49, 1), (50, 2), (1_000_000, 2)]
)
def test_a_stage_begins_with_its_number_of_updates(updates: int, stage: int) -> None:
    assert SimConfig(stages=STAGES).stage(updates) == stage


def test_what_a_stage_plays() -> None:
    sim = SimConfig(stages=STAGES, targets="gaussian", spread=0.4)
    assert sim.task == StageConfig(targets="gaussian", spread=0.4)
    assert [sim.stage_task(stage) for stage in range(3)] == [sim.task, *STAGES]
    assert SimConfig(stages=(StageConfig(),)).stage(0) == 1
    assert SimConfig().stage(99) == 0


def begun(task: StageConfig, layout: Layout = GAME, count: int = 12, **sim: object) -> BatchedEnv:
    config = replace(SimConfig(backend="kinematic"), **sim)  # type: ignore[arg-type]
    env = BatchedEnv(layout, config, RewardConfig(), count)
    env.task = task
    env.reset(evaluation_generators(count))
    return env


def on_target(env: BatchedEnv) -> Bools:
    """(B, K) which tokens lie exactly on their targets."""
    gap = np.abs(env.corners - env.goals).max(axis=2)
    own = [gap[:, env.layout.corners_of(k)].max(axis=1) for k in range(env.layout.tokens)]
    return np.stack(own, axis=1) < 1e-9


@pytest.mark.parametrize("tokens", [1, 3, 6])
@pytest.mark.parametrize("targets", ["uniform", "connected", "figures"])
def test_the_others_lie_on_their_targets_and_are_placed(tokens: int, targets: str) -> None:
    env = begun(StageConfig(tokens=tokens, targets=targets), mirrored=0.5, allow_flip=True)
    assert (env.placed.sum(axis=1) == 7 - tokens).all()
    np.testing.assert_array_equal(on_target(env), env.placed)
    assert len(np.unique(env.placed, axis=0)) > 3  # drawn for each


def test_tokens_to_move_start_clear_of_those_that_lie() -> None:
    """Also where starts may be anywhere: they lie on the table, not on each other."""
    env = begun(StageConfig(tokens=3), count=40)
    sides = GAME.flipped(env.corners)
    for poses, flipped in zip(GAME.poses(env.corners), sides, strict=True):
        assert largest_overlap(GAME, poses, flipped) < 1e-8


@pytest.mark.parametrize("tokens", [0, 7, 9])
def test_all_tokens_or_more_are_the_whole_task(tokens: int) -> None:
    env, whole = begun(StageConfig(tokens=tokens)), begun(StageConfig())
    assert not env.placed.any()
    np.testing.assert_array_equal(env.corners, whole.corners)


def test_what_lies_on_its_target_is_refused_and_the_rest_fills_the_episode() -> None:
    env = begun(StageConfig(tokens=1), count=4)
    placed = env.placed.argmax(axis=1)
    before = env.corners.copy()
    actions = np.full((4, 4), 0.3)
    actions[:, 0] = (placed + 0.5) / 3.5 - 1.0
    assert env.step(actions).refused.all()
    np.testing.assert_array_equal(env.corners, before)
    actions[:, 0] = (env.placed.argmin(axis=1) + 0.5) / 3.5 - 1.0
    result = env.step(actions)
    assert not result.refused.any()
    assert env.placed.all()
    assert not result.done


def test_the_next_episode_is_that_of_the_task() -> None:
    env = begun(StageConfig(tokens=2))
    env.task = env.sim.task
    env.reset(evaluation_generators(12))
    assert not env.placed.any()


def test_an_episode_in_a_stage_depends_on_its_own_generator_only() -> None:
    task = StageConfig(tokens=3, targets="mixed")
    together = begun(task, starts="outside", allow_flip=True)
    for b in range(3):
        alone = BatchedEnv(GAME, together.sim, RewardConfig(), 1)
        alone.task = task
        alone.reset(evaluation_generators(12)[b : b + 1])
        np.testing.assert_array_equal(alone.corners[0], together.corners[b])
        np.testing.assert_array_equal(alone.placed[0], together.placed[b])


def test_given_targets_are_played() -> None:
    env, other = begun(StageConfig()), begun(StageConfig(targets="figures"), mirrored=0.5)
    poses, sides = GAME.poses(other.goals), GAME.flipped(other.goals)
    env.reset(evaluation_generators(12), (poses, sides))
    np.testing.assert_allclose(env.goals, other.goals, atol=1e-9)
    assert env.steps_done == 0
    with pytest.raises(ValueError, match="need 12 generators, got 3"):
        env.reset(evaluation_generators(3), (poses, sides))
