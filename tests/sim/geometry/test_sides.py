"""Tokens on their other side: geometry, both worlds, and the actions that turn them over."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_core.arrays import Bools, Floats
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.overlap import covered_share
from tangram_sim.geometry.shapes import SHAPE_NAMES, Shape, mirror_image, polygon, tan, turn_onto
from tangram_sim.motion.actions import action_size, flips
from tangram_sim.sight.pictures import TOKEN_GRAY, rasterise
from tangram_sim.world.world import World, make_world
from tests.sim.builders import LOPSIDED, SEVEN, evaluation_generators, layout_of, random_poses

pytestmark = pytest.mark.fast

# Two chiral tokens, one of them the user's own, and two that are not.
LAYOUT = layout_of("parallelogram", "square", LOPSIDED, "large_triangle", scale=0.3)
IMAGE = mirror_image(tan("parallelogram").corners)
MIRROR = np.array([1.0, -1.0])


def drawn(size: int, seed: int = 0) -> tuple[Floats, Bools]:
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, size, LAYOUT.tokens, 0.6)
    return poses, (rng.random((size, LAYOUT.tokens)) < 0.5) & LAYOUT.chiral


OWN = [
    ([[0, -1], [1, 0], [0, 3], [-1, 0]], False),  # a kite
    ([[0, 0], [2, 0], [2, 1], [0, 1]], False),
    ([[0, 0], [3, 0], [2, 1], [1, 1]], False),  # equal legs
    ([[0, 0], [4, 0], [3, 1], [0, 2]], True),
    ([[0, 0], [3, 0], [0, 2]], True),
    ([[0, 0], [2, 0], [3, 1], [1, 1]], True),  # a parallelogram
]
TANS = [(tan(name), name.startswith("parallelogram")) for name in SHAPE_NAMES]


@pytest.mark.parametrize(
    ("shape", "chiral"), [*TANS, *((polygon("own", corners), told) for corners, told in OWN)]
)
def test_which_polygons_are_chiral(shape: Shape, chiral: bool) -> None:
    assert (shape.mirror is None) == chiral
    if shape.mirror is not None:
        turned = shape.corners @ (1.0, 1j) * np.exp(1j * shape.mirror)
        image = mirror_image(shape.corners) @ (1.0, 1j)
        assert np.abs(turned[:, None] - image).min(axis=1).max() < 1e-12


@pytest.mark.parametrize(
    ("first", "second", "found"),
    [
        ("parallelogram_mirrored", IMAGE, True),
        ("parallelogram", IMAGE, False),
        ("square", tan("small_triangle").corners, False),
        ("small_triangle", tan("large_triangle").corners, False),  # larger, of the same form
        ("square", tan("square").corners, True),
    ],
)
def test_which_polygons_a_turn_maps_onto_each_other(
    first: str, second: Floats, found: bool
) -> None:
    assert (turn_onto(tan(first).corners, second) is not None) == found


def test_a_layout_knows_its_chiral_tokens() -> None:
    assert LAYOUT.chiral.tolist() == [True, False, True, False]
    assert layout_of(*SEVEN).chiral.tolist() == [False] * 6 + [True]
    assert not layout_of("square", "small_triangle").any_chiral


def test_a_token_is_turned_over_about_its_own_x_axis() -> None:
    layout = layout_of("parallelogram", scale=1.0)
    pose = np.array([[0.3, 0.4, 0.0]])
    expected = layout.body * MIRROR + [0.3, 0.4]
    np.testing.assert_allclose(layout.corners(pose, np.array([True])), expected, atol=1e-15)


def test_a_mirrored_layout_is_the_mirror_image() -> None:
    poses, sides = drawn(50)
    image, other = LAYOUT.mirrored(poses, sides)
    np.testing.assert_array_equal(other, sides ^ LAYOUT.chiral)
    wanted = LAYOUT.corners(poses, sides) * MIRROR
    got = LAYOUT.corners(image, other)
    for k in range(LAYOUT.tokens):
        own = LAYOUT.corners_of(k)
        gaps = np.linalg.norm(got[:, own, None] - wanted[:, None, own], axis=-1)
        assert gaps.min(axis=2).max() < 1e-12


@given(st.integers(0, 10_000))
@settings(max_examples=60)
def test_overlap_is_the_same_in_the_mirror(seed: int) -> None:
    """All of it: that of tokens on either side, and of both sides in one place."""
    states, targets = drawn(2, seed), drawn(2, seed + 1)
    share = covered_share(LAYOUT.corners(*states), LAYOUT.corners(*targets), LAYOUT)
    mirrored = [LAYOUT.corners(*LAYOUT.mirrored(*layout)) for layout in (states, targets)]
    np.testing.assert_allclose(covered_share(mirrored[0], mirrored[1], LAYOUT), share, atol=1e-9)
    own = LAYOUT.corners(*states)
    assert (covered_share(own, own, LAYOUT) > 0.5).all()


def test_sides_are_told_of_noisy_corners() -> None:
    layout = layout_of("parallelogram", scale=1.0)
    sides = np.random.default_rng(1).random((200, 1)) < 0.5
    corners = layout.corners(random_poses(np.random.default_rng(0), 200, 1, 0.5), sides)
    noisy = corners + np.random.default_rng(2).normal(0.0, 0.04, corners.shape)
    np.testing.assert_array_equal(layout.flipped(noisy), sides)


@pytest.fixture(params=["physics", "kinematic"])
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    made = make_world(LAYOUT, SimConfig(backend=request.param, pixels=64))
    yield made
    made.close()


def test_worlds_place_tokens_on_either_side_and_turn_them_over_and_back(world: World) -> None:
    for poses, sides in zip(*drawn(20), strict=True):
        world.place(poses, sides)
        np.testing.assert_array_equal(world.flipped(), sides)
        np.testing.assert_allclose(world.poses(), poses, atol=1e-9)
    world.place(poses)
    assert not world.flipped().any()
    start, way = np.zeros((4, 3)), np.array([0.1, -0.2, 2.5])
    start[:, :2] = [[-0.6, 0], [0.6, 0], [0, 1.2], [0, -1.2]]
    for token in (0, 2):
        world.place(start)
        world.move(token, way, True)
        expected, sides = start.copy(), np.arange(4) == token
        expected[token] += way
        got = LAYOUT.corners(world.poses(), world.flipped())
        np.testing.assert_allclose(got, LAYOUT.corners(expected, sides), atol=1e-6)
        world.move(token, -way, True)
        got = LAYOUT.corners(world.poses(), world.flipped())
        np.testing.assert_allclose(got, LAYOUT.corners(start), atol=1e-6)


def test_pictures_show_tokens_on_their_side(world: World) -> None:
    """Pixel for pixel, but for centres that lie on an edge to rounding."""
    wrong, seen = 0, 0
    for poses, sides in zip(*drawn(25), strict=True):
        world.place(poses, sides)
        picture = world.picture()
        exact = rasterise(LAYOUT.corners(poses, sides), LAYOUT, 2.0, 64)
        wrong += int(np.count_nonzero(picture != exact))
        other = rasterise(LAYOUT.corners(poses, ~sides & LAYOUT.chiral), LAYOUT, 2.0, 64)
        seen += int(np.count_nonzero(other != exact))
        assert (picture == TOKEN_GRAY).any()
    assert wrong <= 10 < seen


def env_of(*shapes: Any, count: int = 32, **sim: Any) -> BatchedEnv:
    config = SimConfig(**{"backend": "kinematic", "allow_flip": True, **sim})
    env = BatchedEnv(layout_of(*shapes, scale=0.6), config, RewardConfig(), count)
    env.reset(evaluation_generators(count))
    return env


def test_an_action_has_an_entry_for_the_flip() -> None:
    sim = SimConfig(allow_flip=True)
    assert [action_size(tokens, sim) for tokens in (1, 2, 7)] == [4, 5, 5]
    assert [action_size(tokens, SimConfig()) for tokens in (1, 2, 7)] == [3, 4, 4]
    actions = np.zeros((4, 5))
    actions[:, 0], actions[:, 1] = [-1, -1, 1, 1], [1.0, 0.0, 1e-9, -1.0]
    pair = layout_of("parallelogram", "parallelogram")
    assert flips(actions, pair, sim).tolist() == [True, False, True, False]
    assert not flips(actions[:, 1:], pair, SimConfig()).any()


def test_a_token_that_is_its_own_mirror_image_is_never_turned_over() -> None:
    env = env_of("square", "parallelogram", starts="outside")
    before = env.corners.copy()
    result = env.step(np.tile([-1.0, 1.0, 0.0, 0.0, 0.0], (32, 1)))
    np.testing.assert_allclose(env.corners, before, atol=1e-12)
    assert not result.blocked.any()
    env.step(np.tile([1.0, 1.0, 0.0, 0.0, 0.0], (32, 1)))
    assert np.abs(env.corners - before).max(axis=(1, 2)).min() > 0.01


def onto_targets(env: BatchedEnv) -> Floats:
    """Actions that move each environment's only token exactly onto its target."""
    motion = env.layout.poses(env.goals)[:, 0] - env.layout.poses(env.corners)[:, 0]
    motion[:, 2] = np.angle(np.exp(1j * motion[:, 2]))
    flip = np.where(env.layout.flipped(env.corners) != env.layout.flipped(env.goals), 1.0, -1.0)
    actions: Floats = np.concatenate([flip, motion / [2.0, 2.0, np.pi]], axis=1)
    return actions


def test_flips_and_starts_on_any_side() -> None:
    env = env_of("parallelogram", count=64)
    assert 16 < env.layout.flipped(env.corners).sum() < 48
    assert not env.layout.flipped(env.goals).any()
    np.testing.assert_allclose(env.step(onto_targets(env)).coverage, 1.0, atol=1e-9)


@pytest.mark.parametrize("backend", ["physics", "kinematic"])
def test_the_camera_agrees_on_either_side(backend: str) -> None:
    env = env_of("parallelogram", count=8, mirrored=1.0, pixels=64, backend=backend)
    env.step(np.zeros((8, 4)))  # whose target is forgotten
    env.reset(evaluation_generators(8))
    result = env.step(onto_targets(env))
    assert result.camera_rewards is not None
    np.testing.assert_allclose(result.camera_rewards, 1.0, atol=0.02)
    env.close()
