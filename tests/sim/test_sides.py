"""Tokens on their other side: poses, corners, pictures and overlaps of the mirror image."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_sim.arrays import Bools, Floats
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry import area, outlines, overlap_share
from tangram_sim.rewards import make_reward
from tangram_sim.shapes import SHAPE_NAMES, mirror_image, polygon, tan, turn_onto
from tests.sim.builders import LOPSIDED, SEVEN, angle_gap, layout_of, random_poses

pytestmark = pytest.mark.fast

CHIRAL = {"parallelogram", "parallelogram_mirrored"}
# Two chiral tokens, one of them the user's own, and two that are not.
LAYOUT = layout_of("parallelogram", "square", LOPSIDED, "large_triangle", scale=0.3)
MIRROR = np.array([1.0, -1.0])


def drawn(size: int, seed: int = 0) -> tuple[Floats, Bools]:
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, size, LAYOUT.tokens, 0.6)
    return poses, (rng.random((size, LAYOUT.tokens)) < 0.5) & LAYOUT.chiral


@pytest.mark.parametrize("name", SHAPE_NAMES)
def test_which_tans_are_chiral(name: str) -> None:
    shape = tan(name)
    assert (shape.mirror is None) == (name in CHIRAL)
    if shape.mirror is not None:
        turned = shape.corners @ (1.0, 1j) * np.exp(1j * shape.mirror)
        image = mirror_image(shape.corners) @ (1.0, 1j)
        assert np.abs(turned[:, None] - image).min(axis=1).max() < 1e-12


@pytest.mark.parametrize(
    ("corners", "chiral"),
    [
        ([[0, -1], [1, 0], [0, 3], [-1, 0]], False),  # a kite
        ([[0, 0], [2, 0], [2, 1], [0, 1]], False),
        ([[0, 0], [3, 0], [2, 1], [1, 1]], False),  # equal legs
        ([[0, 0], [4, 0], [3, 1], [0, 2]], True),
        ([[0, 0], [3, 0], [0, 2]], True),
        ([[0, 0], [2, 0], [3, 1], [1, 1]], True),  # a parallelogram
    ],
)
def test_which_own_polygons_are_chiral(corners: list[list[float]], chiral: bool) -> None:
    assert (polygon("own", corners).mirror is None) == chiral


def test_one_parallelogram_turned_over_is_the_other() -> None:
    image = mirror_image(tan("parallelogram").corners)
    assert turn_onto(tan("parallelogram_mirrored").corners, image) is not None
    assert turn_onto(tan("parallelogram").corners, image) is None
    assert turn_onto(tan("square").corners, tan("small_triangle").corners) is None
    assert turn_onto(tan("small_triangle").corners, tan("large_triangle").corners) is None


def test_a_layout_knows_its_chiral_tokens() -> None:
    assert LAYOUT.chiral.tolist() == [True, False, True, False]
    assert layout_of(*SEVEN).chiral.tolist() == [False] * 6 + [True]
    assert not layout_of("square", "small_triangle").any_chiral


def test_sides_poses_and_corners_round_trip() -> None:
    poses, sides = drawn(200)
    corners = LAYOUT.corners(poses, sides)
    np.testing.assert_array_equal(LAYOUT.flipped(corners), sides)
    back = LAYOUT.poses(corners)
    np.testing.assert_allclose(back[..., :2], poses[..., :2], atol=1e-12)
    assert angle_gap(back[..., 2], poses[..., 2]).max() < 1e-12
    np.testing.assert_allclose(LAYOUT.bases(corners), poses[..., :2], atol=1e-12)


def test_a_token_is_turned_over_about_its_own_x_axis() -> None:
    layout = layout_of("parallelogram", scale=1.0)
    pose = np.array([[0.3, 0.4, 0.0]])
    expected = layout.body * MIRROR + [0.3, 0.4]
    np.testing.assert_allclose(layout.corners(pose, np.array([True])), expected, atol=1e-15)


def test_outlines_run_counter_clockwise_on_both_sides() -> None:
    corners = LAYOUT.corners(*drawn(50))
    own = outlines(corners, LAYOUT)
    for k, shape in enumerate(LAYOUT.shapes):
        np.testing.assert_allclose(area(own[:, k]), shape.area, atol=1e-12)


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
@settings(deadline=None, max_examples=60)
def test_overlap_is_the_same_in_the_mirror(seed: int) -> None:
    """All of it: that of tokens on either side, and of both sides in one place."""
    states, targets = drawn(2, seed), drawn(2, seed + 1)
    share = overlap_share(LAYOUT.corners(*states), LAYOUT.corners(*targets), LAYOUT)
    mirrored = [LAYOUT.corners(*LAYOUT.mirrored(*layout)) for layout in (states, targets)]
    np.testing.assert_allclose(overlap_share(mirrored[0], mirrored[1], LAYOUT), share, atol=1e-9)
    own = LAYOUT.corners(*states)
    assert (overlap_share(own, own, LAYOUT) > 0.5).all()


def test_the_wrong_side_does_not_cover_the_target() -> None:
    layout = layout_of("parallelogram", scale=1.0)
    turns = np.zeros((90, 1, 3))
    turns[:, 0, 2] = np.linspace(0.0, np.pi, 90)
    goal = layout.corners(np.zeros((90, 1, 3)))
    on = [layout.corners(turns, np.full((90, 1), side)) for side in (False, True)]
    assert overlap_share(on[0], goal, layout).max() == pytest.approx(1.0)
    assert 0.7 < overlap_share(on[1], goal, layout).max() < 0.9


def test_sides_are_told_of_noisy_corners_and_rewarded_as_rigid_pieces() -> None:
    layout = layout_of("parallelogram", scale=1.0)
    sides = np.random.default_rng(1).random((200, 1)) < 0.5
    corners = layout.corners(random_poses(np.random.default_rng(0), 200, 1, 0.5), sides)
    noisy = corners + np.random.default_rng(2).normal(0.0, 0.04, corners.shape)
    np.testing.assert_array_equal(layout.flipped(noisy), sides)
    reward = make_reward(RewardConfig(), layout, SimConfig(corner_noise=0.02))
    shifted = corners + 0.1
    expected = 2.0 * overlap_share(shifted, corners, layout) - 1.0
    np.testing.assert_allclose(reward(shifted, corners), expected, atol=1e-9)
