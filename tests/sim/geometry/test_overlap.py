"""Overlap areas against shapely and against what geometry demands."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_core.arrays import Floats
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import (
    area,
    clip,
    covered_share,
    outlines,
    overlap_area,
    pairs_overlap,
    union_area,
)
from tangram_sim.geometry.shapes import SHAPE_NAMES, tan
from tangram_sim.targets.sampling import sample_batch
from tests.sim.builders import SEVEN, TRIO, layout_of, polygons, random_poses

pytestmark = pytest.mark.fast

UNIT = [[0, 0], [1, 0], [1, 1], [0, 1]]
quick = settings(max_examples=60)
names = st.sampled_from(SHAPE_NAMES)
poses = st.tuples(*[st.floats(-1.0, 1.0)] * 2, st.floats(-np.pi, np.pi))


def oracle_overlap(layout: Layout, tokens: Floats, targets: Floats) -> float:
    # A grid: without it GEOS may return a whole piece for two that only touch.
    union = shapely.union_all(polygons(layout, tokens), grid_size=1e-9)
    whole = shapely.union_all(polygons(layout, targets), grid_size=1e-9)
    return float(shapely.intersection(union, whole, grid_size=1e-9).area)


@pytest.mark.parametrize(
    ("shapes", "scale", "size"),
    [
        (("square",), 2.0, 100),
        (("small_triangle",), 2.0, 100),
        (TRIO, 1.4, 60),
        (SEVEN, 0.8, 30),  # tokens overlap each other: counted once
    ],
)
def test_overlap_area_equals_shapely(shapes: tuple[str, ...], scale: float, size: int) -> None:
    layout = layout_of(*shapes, scale=scale)
    rng = np.random.default_rng(0)
    tokens = layout.corners(random_poses(rng, size, layout.tokens, 0.6))
    targets = layout.corners(sample_batch(layout, SimConfig(), [rng] * size))
    got = overlap_area(tokens, targets, layout)
    expected = [oracle_overlap(layout, t, g) for t, g in zip(tokens, targets, strict=True)]
    np.testing.assert_allclose(got, expected, atol=1e-7)
    assert np.count_nonzero(got > 0.01) > size / 4


@pytest.mark.parametrize("shapes", [("square",), TRIO, SEVEN])
def test_union_area_equals_shapely(shapes: tuple[str, ...]) -> None:
    layout = layout_of(*shapes, scale=1.0)
    tokens = layout.corners(random_poses(np.random.default_rng(2), 40, layout.tokens, 0.4))
    unions = [shapely.union_all(polygons(layout, one), grid_size=1e-9).area for one in tokens]
    np.testing.assert_allclose(union_area(tokens, layout), unions, atol=1e-7)


def test_pairs_overlap_as_shapely_says_and_touching_is_none() -> None:
    layout = layout_of("parallelogram", "square", scale=1.0)
    corners = layout.corners(random_poses(np.random.default_rng(1), 200, 2, 0.4))
    expected = []
    for tokens in corners:
        shared = shapely.intersection(*polygons(layout, tokens), grid_size=1e-9)
        expected.append(shared.area > 1e-8)
    first, second = outlines(corners, layout).swapaxes(0, 1)
    assert pairs_overlap(first, second).tolist() == expected
    assert 20 < sum(expected) < 180
    side, gaps = np.array([UNIT] * 5), [0.0, 0.5, 1.0 - 1e-6, 1.0, 1.5]
    moved = side + np.array([[[gap, 0.0]] for gap in gaps])
    assert pairs_overlap(side, moved).tolist() == [True, True, True, False, False]


@given(names, names, poses, poses)
@quick
def test_an_intersection_is_symmetric_and_bounded_and_a_piece_meets_all_of_itself(
    first: str, second: str, pose: tuple[float, ...], other: tuple[float, ...]
) -> None:
    a, b = _placed(first, pose), _placed(second, other)
    forth, back = area(clip(a, b))[0], area(clip(b, a))[0]
    assert forth == pytest.approx(back, abs=1e-12)
    assert -1e-12 <= forth <= min(area(a)[0], area(b)[0]) + 1e-12
    assert area(clip(a, a))[0] == pytest.approx(tan(first).area, abs=1e-12)


@given(names, poses, st.integers(0, 3))
@quick
def test_pieces_that_share_an_edge_only_touch(
    name: str, pose: tuple[float, ...], edge: int
) -> None:
    """The mirror image at one of its edges lies on the other side of a coincident edge."""
    piece = _placed(name, pose)
    start = piece[0, edge % piece.shape[1]]
    along = piece[0, (edge + 1) % piece.shape[1]] - start
    along = along / np.linalg.norm(along)
    offset = piece[0] - start
    mirrored = start + 2.0 * (offset @ along)[:, None] * along - offset
    neighbour = mirrored[::-1][None]  # mirroring turned the direction
    assert area(neighbour)[0] == pytest.approx(tan(name).area)
    assert area(clip(piece, neighbour))[0] == pytest.approx(0.0, abs=1e-12)


def test_coincident_edges_inside() -> None:
    """A corner piece of a square, both on the grid: two edges coincide, the rest is inside."""
    unit = np.array([UNIT], dtype=float)
    cases = [(unit, unit * 0.5), (unit * 0.5, unit), (unit, unit + [1, 0]), (unit, unit + [3, 0])]
    assert [area(clip(*pair))[0] for pair in cases] == [0.25, 0.25, 0.0, 0.0]


@pytest.mark.parametrize(
    ("second", "places", "share"),
    [
        ("square", (0.0, 0.0), 1 / 2),  # both on one: counted once
        ("square", (2.0, 0.0), 1.0),  # swapped
        ("square", (0.0, 2.0), 1.0),
        ("small_triangle", (0.0, 9.0), 2 / 3),  # of the target's area, not of what lies there
    ],
)
def test_the_share_is_of_the_targets_area_and_counts_a_place_once(
    second: str, places: tuple[float, float], share: float
) -> None:
    layout = layout_of("square", second, scale=1.0)
    poses = np.zeros((2, 1, 2, 3))
    poses[0, 0, :, 0], poses[1, 0, :, 0] = places, (0.0, 2.0)
    assert covered_share(*layout.corners(poses), layout)[0] == pytest.approx(share)


def _placed(name: str, pose: tuple[float, ...]) -> Floats:
    x, y, angle = pose
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved: Floats = tan(name).corners[None] @ turn.T + [x, y]
    return moved
