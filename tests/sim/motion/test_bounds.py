"""What an action moves, and how far corners can come."""

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.targets import check_targets
from tests.sim.builders import TRIO, evaluation_generators, layout_of

pytestmark = pytest.mark.fast

ONE = layout_of("square", scale=0.3)
THREE = layout_of(*TRIO, scale=0.5)


def begun(layout: Layout = ONE, count: int = 3, **sim: Any) -> BatchedEnv:
    env = BatchedEnv(layout, SimConfig(**{"backend": "kinematic"} | sim), RewardConfig(), count)
    env.reset(evaluation_generators(count))
    return env


@pytest.mark.parametrize("backend", ["kinematic", "physics"])
def test_a_step_draws_nothing(backend: str) -> None:
    own = evaluation_generators(3)
    with closing(begun(backend=backend)) as env:
        env.reset(own)
        _ = [generator.random() for generator in own]
        env.step(np.full((3, 3), 0.1))
        _ = [generator.random() for generator in own]
        after = [generator.random() for generator in own]
    fresh = evaluation_generators(3)
    with closing(BatchedEnv(ONE, SimConfig(backend="kinematic"), RewardConfig(), 3)) as other:
        other.reset(fresh)
    assert [[generator.random() for _ in range(3)][2] for generator in fresh] == after


@pytest.mark.parametrize("backend", ["kinematic", "physics"])
def test_the_same_generators_play_the_same_whoever_plays_beside_them(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As lockstep and the fixed tests ask for."""
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 1.0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 5, 4))
    ends = []
    for count in (5, 5, 2):
        with closing(begun(THREE, count, backend=backend, actions_per_token=2)) as env:
            for _ in range(2):  # nothing is left of the episode before
                env.reset(evaluation_generators(count))
                rows = [env.step(step[:count]).rewards[:2] for step in actions]
            ends.append([env.corners[:2], rows])
    for other in (1, 2):
        for one, two in zip(ends[0], ends[other], strict=True):
            np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("seed", range(12))
def test_no_world_leaves_the_bound(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages are checked against it; and no shift is longer than an action says."""
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 1.0)
    rng, engine = np.random.default_rng(seed), seed % 3 > 0
    sim = SimConfig(
        backend="physics" if engine else "kinematic",
        arena=float(rng.choice([1.5, 2.0, 100.0])),
        actions_per_token=int(rng.integers(2, 4)),
    )
    layout = layout_of("square", "large_triangle", scale=0.2 * sim.arena)
    check_targets(layout, sim)
    slack = 0.25  # what settles
    with closing(BatchedEnv(layout, sim, RewardConfig(), 4)) as env:
        for _ in range(2):
            env.reset([np.random.default_rng([seed, b]) for b in range(4)])
            ahead = rng.choice([-1.0, 1.0], (4, 4))  # the same all the way
            for step in range(env.horizon):
                before = env.layout.poses(env.corners)
                ahead[:, 0] = -0.5 if step < sim.actions_per_token else 0.5
                env.step(ahead)
                assert np.abs(env.seen).max() <= env.spec.field("corners").high
                way = np.abs(env.layout.poses(env.corners) - before)[..., :2].max()
                assert way <= sim.arena * (1.0 + slack)
