"""Tokens that slide: what is in the way is pushed, what is not stays, nothing is passed through."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from tangram_sim.actions import corner_bound
from tangram_sim.arrays import Floats
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.errors import ConfigError
from tangram_sim.layout import Layout
from tangram_sim.physics import PhysicsWorld
from tangram_sim.sampling import sample_poses
from tangram_sim.seeding import evaluation_generators
from tests.sim.builders import SEVEN, angle_gap, largest_overlap, layout_of

pytestmark = pytest.mark.fast

GAME = layout_of(*SEVEN, scale=0.6)
MOST = 1e-5  # of area that two tokens share afterwards
SLIDE = SimConfig(motion="slide")


@pytest.fixture
def worlds() -> Iterator[list[PhysicsWorld]]:
    made: list[PhysicsWorld] = []
    yield made
    for world in made:
        world.close()


def make(worlds: list[PhysicsWorld], layout: Layout, sim: SimConfig = SLIDE) -> PhysicsWorld:
    worlds.append(PhysicsWorld(layout, sim))
    return worlds[-1]


def pushed(world: PhysicsWorld, start: Sequence[Sequence[float]], way: Sequence[float]) -> Floats:
    """Poses after token 0 went its way."""
    world.place(np.array(start))
    world.move(0, np.array(way))
    return world.poses()


def test_a_token_in_the_way_is_pushed_ahead(worlds: list[PhysicsWorld]) -> None:
    world = make(worlds, layout_of("square", "square"))
    poses = pushed(world, [[-0.7, 0.0, 0.0], [0.0, 0.0, 0.0]], [0.9, 0.0, 0.0])
    np.testing.assert_allclose(poses[0], [0.2, 0.0, 0.0], atol=1e-9)
    assert poses[1, 0] == pytest.approx(0.6, abs=2e-3)
    # A push along the middle turns it hardly.
    assert np.abs(poses[1, 1:]).max() < 0.05


def test_a_push_off_the_middle_turns(worlds: list[PhysicsWorld]) -> None:
    world = make(worlds, layout_of("square", "square"))
    poses = pushed(world, [[-0.7, 0.25, 0.0], [0.0, 0.0, 0.0]], [0.7, 0.0, 0.0])
    assert poses[1, 2] < -0.1


def test_a_turning_token_pushes_too(worlds: list[PhysicsWorld]) -> None:
    beam = {"name": "beam", "corners": [[0, 0], [6, 0], [6, 1], [0, 1]]}
    layout = layout_of(beam, "small_triangle", scale=0.2)
    poses = pushed(make(worlds, layout), [[0, 0, 0], [0.4, 0.3, 0.0]], [0, 0, 1.2])
    np.testing.assert_allclose(poses[0], [0, 0, 1.2], atol=1e-9)
    assert np.linalg.norm(poses[1, :2] - [0.4, 0.3]) > 0.1


def test_a_push_goes_on_through_a_chain(worlds: list[PhysicsWorld]) -> None:
    """The last one moves though the first never comes near it."""
    layout = layout_of("square", "square", "square", "square", scale=0.6)
    side = 0.6 * 2.0**0.5 / 4.0
    start = [[-0.8, 0, 0], [-0.4, 0, 0], [-0.4 + side, 0, 0], [0.05, 0, 0]]
    poses = pushed(make(worlds, layout), start, [0.45, 0.0, 0.0])
    assert (poses[1:, 0] > np.array(start)[1:, 0] + 0.05).all()
    assert (np.diff(poses[:, 0]) > 0.5 * side).all()
    assert largest_overlap(layout, poses) < MOST


def test_what_is_not_in_the_way_stays(worlds: list[PhysicsWorld]) -> None:
    world = make(worlds, layout_of("square", "square", "square"))
    start = [[-0.7, 0.0, 0.0], [0.0, 0.41, 0.0], [0.0, -0.6, 0.3]]
    poses = pushed(world, start, [1.4, 0.0, 0.0])
    np.testing.assert_allclose(poses[1:], start[1:], atol=1e-9)


@pytest.mark.parametrize("scale", [0.6, 0.1, 0.02])
@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_nothing_is_jumped_over_at_full_speed(
    worlds: list[PhysicsWorld], scale: float, angle: float
) -> None:
    """A small token in the way of a large one, across the whole arena in one second."""
    layout = layout_of("large_triangle", "small_triangle", scale=scale)
    world, size = make(worlds, layout), layout.shapes[0].radius
    for late in np.linspace(0.0, 0.02, 7):
        start = [[-1 - late, -1 - late, angle], [0, 0, 0]]
        poses = pushed(world, start, [2.0, 2.0, 0.0])
        np.testing.assert_allclose(poses[0], [1 - late, 1 - late, angle], atol=1e-9)
        assert np.linalg.norm(poses[1, :2]) > 0.3 * size


@pytest.mark.parametrize("scale", [0.6, 0.15])
def test_pushes_end_apart_and_the_pusher_where_it_was_told(
    worlds: list[PhysicsWorld], scale: float
) -> None:
    layout = layout_of(*SEVEN, scale=scale)
    world, rng = make(worlds, layout), np.random.default_rng(1)
    moved = 0
    for _ in range(60):
        poses, token = sample_poses(layout, SLIDE, rng), int(rng.integers(7))
        way = rng.uniform(-1.0, 1.0, 3) * [2.0, 2.0, np.pi]
        world.place(poses)
        world.move(token, way)
        after = world.poses()
        assert largest_overlap(layout, after) < MOST
        np.testing.assert_allclose(after[token, :2], (poses[token] + way)[:2], atol=1e-9)
        assert angle_gap(after[token, 2], poses[token, 2] + way[2]) < 1e-9
        moved += int(np.abs(after - poses)[:, :2].max(axis=1)[np.arange(7) != token].max() > 0.0)
    assert moved > 5


def test_others_rest_afterwards(worlds: list[PhysicsWorld]) -> None:
    world = make(worlds, layout_of("square", "square", "square"))
    start = [[-0.7, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, -0.8, 0.3]]
    poses = pushed(world, start, [0.8, 0.0, 0.0])
    world.move(2, np.array([0.0, -0.1, 0.0]))
    np.testing.assert_allclose(world.poses()[:2], poses[:2], atol=1e-5)


def test_one_token_alone_slides_as_if_lifted(worlds: list[PhysicsWorld]) -> None:
    layout = layout_of("parallelogram")
    start, ways = [[0.1, -0.2, 0.3]], np.random.default_rng(0).uniform(-2.0, 2.0, (20, 3))
    both = make(worlds, layout), make(worlds, layout, SimConfig())
    for way in ways:
        slid, lifted = (pushed(world, start, way.tolist()) for world in both)
        np.testing.assert_array_equal(slid, lifted)


def test_no_corner_leaves_the_bound() -> None:
    sim, rng = SLIDE, np.random.default_rng(0)
    env = BatchedEnv(GAME, sim, RewardConfig(), 4)
    for _ in range(3):
        env.reset(evaluation_generators(4))
        for token in range(env.horizon):
            actions = np.sign(rng.uniform(-1.0, 1.0, (4, 4)))
            actions[:, 0] = (token + 0.5) / 3.5 - 1.0
            result = env.step(actions)
            assert not result.blocked.any()
            assert not result.covered.any()
            assert np.abs(env.corners).max() <= corner_bound(7, sim)
    env.close()


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"backend": "kinematic"}, "sim.motion=slide needs .* got sim.backend=kinematic: set"),
        ({"allow_flip": True}, "sim.allow_flip=true needs sim.motion=lift, got slide"),
    ],
)
def test_slides_that_cannot_be(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        SimConfig(motion="slide", **settings)
