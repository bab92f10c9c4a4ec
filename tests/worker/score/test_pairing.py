"""Equal tokens are interchangeable, and go where they have the least way."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_tasks.pairing import alike, paired
from tests.sim.builders import SEVEN, layout_of, random_poses

pytestmark = pytest.mark.fast


@given(st.integers(1, 5), st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=100)
def test_no_other_order_costs_less(count: int, seed: int, tied: bool) -> None:
    """Two episodes with `count` equal squares and another token, against all orders of both."""
    layout = layout_of(*["square"] * count, "small_triangle", scale=0.3)
    rng = np.random.default_rng(seed)
    ends, goals = (random_poses(rng, 2, count + 1, 0.8) for _ in range(2))
    if tied:  # several tokens lie on one another
        ends[:, 1:count] = ends[:, :1]
    pairing = paired(layout, layout.corners(ends), layout.corners(goals))
    radius = layout.shapes[0].radius
    for e in range(2):
        assert sorted(pairing.target[e]) == list(range(count + 1))
        assert pairing.target[e, count] == count
        cost = np.linalg.norm(goals[e, None, :count, :2] - ends[e, :count, None, :2], axis=-1)
        turn = goals[e, None, :count, 2] - ends[e, :count, None, 2]
        cost += radius * np.abs((turn + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        orders = permutations(range(count))
        least = min(sum(cost[i, j] for i, j in enumerate(order)) for order in orders)
        found = cost[np.arange(count), pairing.target[e, :count]].sum()
        assert found == pytest.approx(least, abs=1e-9)


def test_sixteen_equal_tokens_find_their_places() -> None:
    layout = layout_of(*["square"] * 16, scale=0.3)
    rng = np.random.default_rng(0)
    goals = random_poses(rng, 3, 16, 0.8)
    orders = np.stack([rng.permutation(16) for _ in range(3)])
    ends = np.take_along_axis(goals, orders[..., None], axis=1) + [1e-3, 0.0, np.pi / 2.0]
    pairing = paired(layout, layout.corners(ends), layout.corners(goals))
    np.testing.assert_array_equal(pairing.target, orders)
    np.testing.assert_allclose(pairing.way, np.broadcast_to([-1e-3, 0, 0], (3, 16, 3)), atol=1e-12)


def test_only_pieces_of_one_shape_change_places() -> None:
    layout = layout_of(*SEVEN)
    groups = [[0, 1], [2], [3, 4], [5], [6]]
    expected = [[any({k, j} <= set(g) for g in groups) for j in range(7)] for k in range(7)]
    assert alike(layout).tolist() == expected
    assert not alike(layout_of("parallelogram", "parallelogram_mirrored"))[0, 1]


@pytest.mark.parametrize("flipped", [False, True])
def test_the_way_leads_to_equal_pieces_whose_bodies_are_turned(flipped: bool) -> None:
    """One shape written twice, the second time turned by a right angle."""
    quarter = [[0, 0], [0, 2], [-1, 3], [-1, 1]]
    body = [[0, 0], [2, 0], [3, 1], [1, 1]]
    layout = layout_of({"name": "a", "corners": body}, {"name": "b", "corners": quarter}, scale=0.2)
    sides = np.array([[flipped, flipped]])
    ends = layout.corners(np.array([[[0.5, 0.0, 0.3], [-0.5, 0.0, -1.0]]]), sides)
    goals = layout.corners(np.array([[[-0.5, 0.1, 0.8], [0.5, 0.1, 0.2]]]), sides)
    pairing = paired(layout, ends, goals)
    assert pairing.target.tolist() == [[1, 0]]
    moved = layout.corners(layout.poses(ends) + pairing.way, sides)[0]
    np.testing.assert_allclose(_outline(moved[:4]), _outline(goals[0, 4:]), atol=1e-9)
    np.testing.assert_allclose(_outline(moved[4:]), _outline(goals[0, :4]), atol=1e-9)


def _outline(corners: np.ndarray) -> np.ndarray:
    return np.array(sorted(np.round(corners, 9).tolist()))


def test_sides_come_before_ways() -> None:
    """Two parallelograms on different sides: the far one of the own side, not the near one."""
    layout = layout_of("parallelogram", "parallelogram", scale=0.3)
    poses = np.array([[[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]]])
    ends = layout.corners(poses, np.array([[True, False]]))
    crossed, straight = (layout.corners(poses, np.array([s])) for s in ([False, True], [True] * 2))
    assert paired(layout, ends, crossed).target.tolist() == [[1, 0]]
    assert not paired(layout, ends, crossed).other_side.any()
    assert paired(layout, ends, straight).target.tolist() == [[0, 1]]
    assert paired(layout, ends, straight).other_side.tolist() == [[False, True]]
