"""Nodes, edges and the maps between poses and corners (Sec. IV-A)."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_sim.errors import ConfigError
from tangram_sim.layout import TokensConfig, make_layout
from tangram_sim.shapes import polygon_centroid
from tests.sim.builders import LOPSIDED, SEVEN, TRIO, angle_gap, layout_of, random_poses

pytestmark = pytest.mark.fast

# Rows and columns: token corners 0-3, base 4, target corners 5-8.
SQUARE_EDGES = [
    "011110000",
    "101110000",
    "110110000",
    "111010000",
    "111101111",
    "000010111",
    "000011011",
    "000011101",
    "000011110",
]


def test_single_square_has_nine_nodes_and_the_edges_of_the_paper() -> None:
    layout = layout_of("square")
    assert (layout.tokens, layout.corner_count, layout.nodes) == (1, 4, 9)
    rows = ["".join("1" if edge else "0" for edge in row) for row in layout.adjacency]
    assert rows == SQUARE_EDGES


def test_edges_of_two_tokens() -> None:
    """Tokens and targets are closed groups; every base sees its own corners and all targets."""
    layout = layout_of("small_triangle", "square")
    groups = {
        "corners": [range(3), range(3, 7)],
        "bases": [7, 8],
        "targets": [range(9, 12), range(12, 16)],
    }
    expected = np.zeros((16, 16), dtype=bool)
    for base, own in zip(groups["bases"], groups["corners"], strict=True):
        for i in [*own, *range(9, 16)]:
            expected[base, i] = expected[i, base] = True
    for group in [*groups["corners"], *groups["targets"]]:
        for i in group:
            for j in group:
                expected[i, j] = i != j
    np.testing.assert_array_equal(layout.adjacency, expected)


def test_state_matrix_of_the_square() -> None:
    layout = layout_of("square")
    corners = layout.corners(np.array([[0.1, 0.2, 0.0]]))
    goal = layout.corners(np.array([[-0.5, 0.3, math.pi / 2]]))
    state = layout.state_matrix(corners, np.array([False]), goal)
    assert state.shape == (9, 4 + 9)
    expected = [  # x, y, part of the target, placed
        [-0.1, 0.0, 0, 0],
        [0.3, 0.0, 0, 0],
        [0.3, 0.4, 0, 0],
        [-0.1, 0.4, 0, 0],
        [0.1, 0.2, 0, 0],
        [-0.3, 0.1, 1, 1],
        [-0.3, 0.5, 1, 1],
        [-0.7, 0.5, 1, 1],
        [-0.7, 0.1, 1, 1],
    ]
    np.testing.assert_allclose(state[:, :4], expected, atol=1e-12)
    np.testing.assert_array_equal(state[:, 4:], layout.adjacency)


def test_placed_flag_belongs_to_the_tokens_corners_and_base() -> None:
    layout = layout_of("small_triangle", "square")
    corners = layout.corners(np.zeros((1, 2, 3)))
    features = layout.node_features(corners, np.array([[False, True]]), corners)
    assert features[0, :, 3].tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 1, 1, 1, 1, 1, 1, 1, 1]
    assert features[0, :, 2].tolist() == [0] * 9 + [1] * 7


finite = st.floats(-10.0, 10.0)


@given(st.lists(st.tuples(finite, finite, st.floats(-math.pi, math.pi)), min_size=4, max_size=4))
@settings(deadline=None, max_examples=100)
def test_poses_and_corners_round_trip(poses: list[tuple[float, float, float]]) -> None:
    layout = layout_of(*TRIO, LOPSIDED)
    back = layout.poses(layout.corners(np.array(poses)))
    np.testing.assert_allclose(back[:, :2], np.array(poses)[:, :2], atol=1e-9)
    assert angle_gap(back[:, 2], np.array(poses)[:, 2]).max() < 1e-9


def test_base_is_the_centre_of_area_also_where_the_mean_of_the_corners_is_not() -> None:
    layout = layout_of(LOPSIDED, "small_triangle", scale=0.1)
    body = layout.shapes[0].corners
    assert np.linalg.norm(body.mean(axis=0)) > 0.01
    corners = layout.corners(random_poses(np.random.default_rng(0), 50, 2, 1.0))
    bases = layout.bases(corners)
    for b in range(50):
        for k in range(2):
            centre = polygon_centroid(corners[b, layout.corners_of(k)])
            np.testing.assert_allclose(bases[b, k], centre, atol=1e-12)


def test_corners_are_stacked_token_after_token() -> None:
    layout = layout_of(*SEVEN, scale=1.0)
    assert layout.starts.tolist() == [0, 3, 6, 9, 12, 15, 19, 23]
    assert (
        layout.token_of_corner.tolist()
        == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3 + [4] * 3 + [5] * 4 + [6] * 4
    )
    assert layout.nodes == 2 * 23 + 7


def test_fingerprint_tells_layouts_apart() -> None:
    same = layout_of("square", "small_triangle").fingerprint()
    assert same == layout_of("square", "small_triangle").fingerprint()
    others = [
        layout_of("small_triangle", "square"),
        layout_of("square", "small_triangle", scale=1.0),
        layout_of("square"),
        layout_of("square", "medium_triangle"),
    ]
    assert same not in {layout.fingerprint() for layout in others}


@pytest.mark.parametrize(
    ("shapes", "scale", "reason"),
    [
        ((), 1.0, "1 to 16 shapes, got 0"),
        (("square",) * 17, 1.0, "1 to 16 shapes, got 17"),
        (("square",), 0.0, "positive, got 0"),
        (("square",), math.nan, "positive, got nan"),
        (("hexagon",), 1.0, "unknown shape 'hexagon'"),
        (({"name": "own"},), 1.0, "keys name and corners"),
        ((3,), 1.0, "keys name and corners"),
        (({"name": "own", "corners": [[0, 0], [1, 1]]},), 1.0, "3 to 16 pairs"),
    ],
)
def test_refused_token_set(shapes: tuple[object, ...], scale: float, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        make_layout(TokensConfig(shapes, scale))
