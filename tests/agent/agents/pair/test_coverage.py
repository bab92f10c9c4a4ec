"""What tokens cover of pieces: exact values in tables, and shapely as the oracle."""

from typing import Any

import numpy as np
import pytest
import torch
from shapely.geometry import Polygon

from tangram_agent.agents.pair.coverage import (
    Lying,
    covered_share,
    covering,
    lying,
    newly_covered,
)
from tangram_agent.agents.pair.covered import Covered
from tangram_sim.geometry.layout import TokensConfig, make_layout
from tests.agent.agents.pair.pair_scenes import SEVEN, random_scene
from tests.sim.builders import polygons

pytestmark = pytest.mark.fast

LAYOUT = make_layout(TokensConfig(**SEVEN))
LARGE, MEDIUM, SMALL, SQUARE, PARALLELOGRAM = 0, 2, 3, 5, 6
AREAS = 0.6**2 * np.array([4, 4, 2, 1, 1, 2, 2]) / 16.0


def at(index: int, pose: Any, flipped: bool = False) -> Lying:
    return Lying(np.array([index]), np.array([pose], np.float64), np.array([flipped]))


@pytest.mark.parametrize("seed", range(2))
def test_single_outlines_are_the_layouts_corners(seed: int) -> None:
    np.testing.assert_allclose(LAYOUT.areas, AREAS)
    poses, sides = random_scene(LAYOUT, np.random.default_rng(seed))
    found = Lying(np.arange(7), poses, sides).outlines(LAYOUT)
    for outline, expected in zip(
        found, polygons(LAYOUT, LAYOUT.corners(poses, sides)), strict=True
    ):
        assert Polygon(outline).symmetric_difference(expected).area < 1e-12
        assert Polygon(outline).exterior.is_ccw


@pytest.mark.parametrize("seed", range(2))
def test_what_lies_is_found_in_corners(seed: int) -> None:
    poses, sides = random_scene(LAYOUT, np.random.default_rng(seed), 3)
    rows, index = np.array([0, 2, 1, 2]), np.array([PARALLELOGRAM, SQUARE, LARGE, PARALLELOGRAM])
    found = lying(LAYOUT.corners(poses, sides).astype(np.float32), LAYOUT, rows, index)
    np.testing.assert_allclose(found.pose, poses[rows, index], atol=1e-6)
    np.testing.assert_array_equal(found.flipped, sides[rows, index])
    np.testing.assert_array_equal(found.index, index)


@pytest.mark.parametrize("seed", range(3))
def test_covering_and_shares_against_shapely(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (poses, sides), (goals, goal_sides) = (random_scene(LAYOUT, rng, 2) for _ in range(2))
    corners, wanted = LAYOUT.corners(poses, sides), LAYOUT.corners(goals, goal_sides)
    expected = np.zeros((2, 7, 7))
    for b in range(2):
        own, pieces = polygons(LAYOUT, corners[b]), polygons(LAYOUT, wanted[b])
        for i, j in np.ndindex(7, 7):
            expected[b, i, j] = own[i].intersection(pieces[j]).area
    found = covering(corners, wanted, LAYOUT)
    assert expected.max() > 0.01
    np.testing.assert_allclose(found, expected, atol=1e-9)
    share = covered_share(found, LAYOUT)
    for b, mover, j in np.ndindex(2, 7, 7):
        others = sum(expected[b, i, j] for i in range(7) if i != mover)
        assert share[b, mover, j] == pytest.approx(min(others / AREAS[j], 1.0), abs=1e-7)


def test_in_tensors_it_is_the_same() -> None:
    """Also where a token lies exactly on its piece, and sides fall on sides."""
    rng = np.random.default_rng(0)
    (poses, sides), (goals, goal_sides) = (random_scene(LAYOUT, rng, 40) for _ in range(2))
    there = rng.random(sides.shape) < 0.3
    poses[there], sides[there] = goals[there], goal_sides[there]
    corners, wanted = LAYOUT.corners(poses, sides), LAYOUT.corners(goals, goal_sides)
    covered = Covered(LAYOUT)
    own, pieces = (covered(torch.from_numpy(one)) for one in (corners, wanted))
    np.testing.assert_array_equal(own[2].numpy(), sides)
    np.testing.assert_allclose(own[0].numpy(), poses[..., :2], atol=1e-12)
    found = covering(corners, wanted, LAYOUT)
    share, worth = (one.numpy() for one in covered.shares(own, pieces))
    np.testing.assert_allclose(share, covered_share(found, LAYOUT), atol=1e-9)
    larger = np.maximum(AREAS[:, None], AREAS)
    np.testing.assert_allclose(worth, (found / larger).sum(axis=2), atol=1e-9)


def test_a_piece_is_covered_once_and_by_others_than_the_token_that_is_to_move() -> None:
    heap, row = np.tile([0.1, 0.2, 0.3], (7, 1)), np.zeros((7, 3))
    row[:, 0] = np.arange(7) - 3.0
    for poses, expected in ((heap, None), (row, 1.0 - np.eye(7))):
        corners = LAYOUT.corners(poses)[None]
        share = covered_share(covering(corners, corners, LAYOUT), LAYOUT)[0]
        assert share.max() == pytest.approx(1.0, abs=1e-9)
        if expected is not None:
            np.testing.assert_allclose(share, expected, atol=1e-9)


@pytest.mark.parametrize("noise", [0.01, 0.1, 0.4])
def test_of_noisy_corners_the_pieces_that_fit_are_covered(noise: float) -> None:
    """Outlines with so much noise may run the other way round, and have a negative area."""
    rng = np.random.default_rng(0)
    corners = LAYOUT.corners(*random_scene(LAYOUT, rng, 50))
    corners = corners + noise * rng.standard_normal(corners.shape)
    goals = LAYOUT.corners(*random_scene(LAYOUT, rng, 50))
    found = covering(corners, goals, LAYOUT)
    fitted = LAYOUT.corners(LAYOUT.poses(corners), LAYOUT.flipped(corners))
    np.testing.assert_allclose(found, covering(fitted, goals, LAYOUT), atol=1e-9)
    assert found.min() >= 0.0
    assert (found <= np.minimum(AREAS[:, None], AREAS) + 1e-9).all()


@pytest.mark.parametrize(
    ("token", "piece", "covered", "expected"),
    [
        (LARGE, LARGE, 0.0, 1.0),
        (LARGE, LARGE, 0.25, 0.75),
        (LARGE, LARGE, 1.0, 0.0),
        # A small one inside of a large piece is worth the ratio of their areas.
        (SMALL, LARGE, 0.0, 0.25),
        (SMALL, LARGE, 0.5, 0.25),
        (SMALL, LARGE, 0.9, 0.1),
        (LARGE, SMALL, 0.0, 0.25),
        (LARGE, SMALL, 0.5, 0.125),
        (MEDIUM, SMALL, 0.0, 0.5),
    ],
)
def test_values_of_tokens_on_the_spot(
    token: int, piece: int, covered: float, expected: float
) -> None:
    """The triangles are similar, so the smaller one lies inside of the larger."""
    # The medium triangle is drawn like the others, with its right angle first.
    own, wanted = at(token, (0.2, -0.1, 0.4)), at(piece, (0.2, -0.1, 0.4))
    found = newly_covered(own, wanted, np.array([covered]), LAYOUT)
    assert found[0] == pytest.approx(expected, abs=1e-9)


def test_values_against_shapely_stay_between_0_and_1() -> None:
    rng = np.random.default_rng(1)
    count = 300
    parts = []
    for _ in range(2):
        poses, sides = random_scene(LAYOUT, rng, count)
        index = rng.integers(7, size=count)
        every = np.arange(count)
        parts.append(Lying(index, poses[every, index] * (0.2, 0.2, 1.0), sides[every, index]))
    covered = rng.random(count)
    found = newly_covered(*parts, covered, LAYOUT)
    own, wanted = ([Polygon(o) for o in part.outlines(LAYOUT)] for part in parts)
    shared = np.array([a.intersection(b).area for a, b in zip(own, wanted, strict=True)])
    left = (1.0 - covered) * AREAS[parts[1].index]
    larger = np.maximum(AREAS[parts[0].index], AREAS[parts[1].index])
    np.testing.assert_allclose(found, np.minimum(shared, left) / larger, atol=1e-9)
    assert found.min() >= 0.0
    assert 0.5 < found.max() <= 1.0
