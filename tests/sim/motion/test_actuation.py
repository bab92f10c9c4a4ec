"""What becomes of an action before a token moves: drawn for each episode, or late."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from tangram_core.errors import ConfigError
from tangram_core.seeding import evaluation_generators
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import full_scale
from tangram_sim.motion.actuation import Actuation, reach
from tangram_sim.targets.targets import check_targets
from tests.sim.builders import TRIO, angle_gap, layout_of

pytestmark = pytest.mark.fast

ONE = layout_of("square", scale=0.3)
THREE = layout_of(*TRIO, scale=0.5)
VARIES: dict[str, Any] = {"world": "drawn", "actions_per_token": 2}
DRAWN = ("gain", "bias", "damping")


def begun(layout: Layout = ONE, count: int = 3, **sim: Any) -> BatchedEnv:
    env = BatchedEnv(layout, SimConfig(**{"backend": "kinematic"} | sim), RewardConfig(), count)
    env.reset(evaluation_generators(count))
    return env


@pytest.mark.parametrize("arena", [2.0, 5.0])
def test_what_an_action_moves(arena: float) -> None:
    """A gain of what it says and a bias beside it, in full scales."""
    action = np.array([[0.3, -0.4, 0.5]])
    with closing(begun(count=1, world="drawn", arena=arena)) as env:
        env.actuation.gain, env.actuation.bias = np.array([[[0.5, 2.0, 1.5]], [[0.1, -0.2, 0.05]]])
        before = env.layout.poses(env.corners)[0, 0]
        env.step(action)
        way = env.layout.poses(env.corners)[0, 0] - before
    way[2] = np.angle(np.exp(1j * (way[2] - np.pi * 0.8)))
    np.testing.assert_allclose(way / full_scale(env.sim), [0.25, -1.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("backend", ["kinematic", "physics"])
def test_the_plain_world_draws_nothing(backend: str) -> None:
    with closing(begun(backend=backend)) as env:
        _ = [generator.random() for generator in env._generators]
        env.step(np.full((3, 3), 0.1))
        _ = [generator.random() for generator in env._generators]
        after = [generator.random() for generator in env._generators]
    fresh = evaluation_generators(3)
    with closing(BatchedEnv(ONE, SimConfig(backend="kinematic"), RewardConfig(), 3)) as other:
        other.reset(fresh)
    assert [[generator.random() for _ in range(3)][2] for generator in fresh] == after


def test_what_varies_is_drawn_after_everything_else() -> None:
    """So targets, starts and what is seen first are those of the world that stays the same."""
    with (
        closing(begun(corner_noise=0.01)) as plain,
        closing(begun(corner_noise=0.01, **VARIES)) as e,
    ):
        for name in ("goals", "corners", "seen", "seen_goals"):
            np.testing.assert_array_equal(getattr(plain, name), getattr(e, name))


def test_what_is_drawn_lies_within_its_spread_and_differs_between_episodes() -> None:
    world = Actuation(SimConfig(world="drawn"), 4000)
    world.begin([np.random.default_rng(i) for i in range(4000)])
    ratios = np.log(world.gain) / np.log(1.25)
    for drawn, low, high in (
        *((ratios[:, i], -1.0, 1.0) for i in range(3)),
        *((world.bias[:, i], -0.05, 0.05) for i in range(3)),
        (world.damping, 0.0, 0.1),
    ):
        ends = np.percentile(drawn, (0, 25, 50, 75, 100))
        np.testing.assert_allclose(ends, np.linspace(low, high, 5), atol=0.03 * (high - low))
        assert low <= ends[0] < ends[-1] <= high
    columns = np.column_stack([world.gain, world.bias, world.damping])
    assert np.abs(np.corrcoef(columns.T) - np.eye(7)).max() < 0.08


@pytest.mark.parametrize("backend", ["kinematic", "physics"])
def test_the_same_generators_play_the_same_whoever_plays_beside_them(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As lockstep and the fixed tests ask for."""
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 1.0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 5, 4))
    ends, worlds = [], []
    for count in (5, 5, 2):
        with closing(begun(THREE, count, backend=backend, **VARIES)) as env:
            for _ in range(2):  # nothing is left of the episode before
                env.reset(evaluation_generators(count))
                rows = [env.step(step[:count]).rewards[:2] for step in actions]
            ends.append([env.corners[:2], rows])
            worlds.append([getattr(env.actuation, name)[:2] for name in DRAWN])
    for other in (1, 2):
        for one, two in zip(ends[0] + worlds[0], ends[other] + worlds[other], strict=True):
            np.testing.assert_array_equal(one, two)


def test_a_damping_that_was_drawn_is_the_engines() -> None:
    action = np.tile([0.5, 0.0, 0.25], (3, 1))
    with closing(begun(backend="physics", world="drawn")) as env:
        env.actuation.gain, env.actuation.bias = np.ones((3, 3)), np.zeros((3, 3))
        env.step(action)
        ends, drawn = env.corners, env.actuation.damping
    assert np.ptp(drawn) > 0.02
    for b, damping in enumerate(drawn.tolist()):
        with closing(begun(backend="physics")) as env:
            env._worlds[b].damp(damping)
            env.step(action)
            np.testing.assert_array_equal(env.corners[b], ends[b])


@pytest.mark.parametrize("backend", ["kinematic", "physics"])
def test_a_late_action_moves_the_token_that_it_named_to_its_side(backend: str) -> None:
    """And what is placed is what was named, so each token has its number of actions."""
    layout = layout_of("square", "parallelogram", scale=0.3)
    late = {"backend": backend, "world": "delayed", "allow_flip": True}
    with closing(begun(layout, 1, **late)) as env:
        start, sides = layout.poses(env.corners), layout.flipped(env.corners)
        first, second = [0.9, 1.0, 0.1, -0.05, 0.2], [-0.9, 1.0, 0.3, 0.3, 0.3]
        result = env.step(np.array([first]))
        np.testing.assert_array_equal(layout.poses(env.corners), start)
        assert env.placed.tolist() == [[False, True]]
        result = env.step(np.array([second]))
        assert (result.tokens.tolist(), result.refused.tolist()) == ([1], [False])
        way = layout.poses(env.corners)[0] - start[0]
        np.testing.assert_allclose(way[1, :2] / env.sim.arena, [0.1, -0.05], atol=1e-6)
        np.testing.assert_allclose(way[0], 0.0, atol=1e-6)
        assert (layout.flipped(env.corners) ^ sides).tolist() == [[False, True]]
        env.reset(evaluation_generators(1))  # what was left over is not played
        start = env.corners
        env.step(np.array([first]))
        np.testing.assert_array_equal(env.corners, start)


def test_a_late_action_that_named_a_placed_token_moves_nothing() -> None:
    with closing(begun(THREE, 1, world="delayed")) as env:
        env.step(np.array([[0.9, 0.0, 0.0, 0.0]]))
        assert env.step(np.array([[0.9, 0.4, 0.0, 0.0]])).refused.all()
        before = env.corners
        env.step(np.array([[-0.9, 0.0, 0.0, 0.0]]))
        np.testing.assert_array_equal(env.corners, before)


def worlds() -> Iterator[tuple[int, SimConfig]]:
    """Worlds of every kind, with small and large arenas."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        world = ("plain", "bullet", "drawn", "delayed")[seed % 4]
        engine = seed % 3 > 0 or world == "bullet"
        slides = engine and world != "bullet" and seed % 2
        yield (
            seed,
            SimConfig(
                backend="physics" if engine else "kinematic",
                motion="slide" if slides else "lift",
                world=world,
                arena=float(rng.choice([1.5, 2.0, 100.0])),
                actions_per_token=int(rng.integers(2, 4)),
                corner_noise=float(rng.choice([0.0, 0.2])),
            ),
        )


@pytest.mark.parametrize(("seed", "sim"), list(worlds()))
def test_no_world_leaves_the_bound(
    seed: int, sim: SimConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages are checked against it; and no shift is longer than `reach` says."""
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 1.0)
    layout = layout_of("square", "large_triangle", scale=0.2 * sim.arena)
    rng = np.random.default_rng(seed)
    check_targets(layout, sim)
    with closing(BatchedEnv(layout, sim, RewardConfig(), 4)) as env:
        for _ in range(2):
            env.reset([np.random.default_rng([seed, b]) for b in range(4)])
            ahead = rng.choice([-1.0, 1.0], (4, 4))  # the same all the way
            for step in range(env.horizon):
                before = env.layout.poses(env.corners)
                ahead[:, 0] = -0.5 if step < sim.actions_per_token else 0.5
                env.step(ahead)
                assert np.abs(env.seen).max() <= env.bound
                way = np.abs(env.layout.poses(env.corners) - before)[..., :2].max()
                slack = (
                    0.25 * sim.arena if sim.motion == "lift" else sim.arena
                )  # what settles, what is pushed
                assert way <= sim.arena * reach(sim)[:2].max() + slack


def test_a_token_alone_goes_as_far_as_the_bound_says() -> None:
    """So the bound is not merely large."""
    with closing(begun(world="drawn", actions_per_token=3)) as env:
        env.actuation.gain, env.actuation.bias = np.full((3, 3), 1.25), np.full((3, 3), 0.05)
        for _ in range(3):
            env.step(np.ones((3, 3)))
        assert 0.9 * env.bound < np.abs(env.corners).max() <= env.bound


def test_commands_are_what_a_token_is_to_be_told() -> None:
    rng, count = np.random.default_rng(0), 50
    world = Actuation(SimConfig(**VARIES), count)
    world.begin([np.random.default_rng(i) for i in range(count)])
    scale = full_scale(SimConfig())
    wanted = rng.uniform(-0.4, 0.4, (count, 3)) * scale
    told = world.told(world.commands(wanted) * scale)
    np.testing.assert_allclose(told[:, :2], wanted[:, :2], atol=1e-12)
    assert angle_gap(told[:, 2], wanted[:, 2]).max() < 1e-12
    assert np.abs(world.commands(wanted * 10.0)).max() == 1.0


def test_a_delayed_episode_of_one_action_is_refused() -> None:
    reason = "^sim.world=delayed moves nothing in an episode of one action: .* sim.world=plain$"
    with pytest.raises(ConfigError, match=reason):
        check_targets(ONE, SimConfig(world="delayed"))
    check_targets(ONE, SimConfig(world="delayed", actions_per_token=2))
