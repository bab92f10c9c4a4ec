"""Nodes, edges and the maps between poses and corners (Sec. IV-A)."""

import math
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_core.errors import ConfigError
from tangram_sim.geometry.layout import TokensConfig, make_layout
from tests.sim.builders import LOPSIDED, TRIO, angle_gap, layout_of

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
    groups = [range(3), range(3, 7), range(9, 12), range(12, 16)]
    edges = {pair for group in groups for pair in permutations(group, 2)}
    for base, own in ((7, range(3)), (8, range(3, 7))):
        edges |= {pair for i in [*own, *range(9, 16)] for pair in ((base, i), (i, base))}
    assert set(zip(*map(list, np.nonzero(layout.adjacency)), strict=True)) == edges


coordinate = st.floats(-10.0, 10.0)
pose = st.tuples(coordinate, coordinate, st.floats(-math.pi, math.pi), st.booleans())


@given(st.lists(pose, min_size=4, max_size=4))
@settings(max_examples=60)
def test_poses_sides_and_corners_round_trip(tokens: list[tuple[float, float, float, bool]]) -> None:
    layout, poses = layout_of(*TRIO, LOPSIDED), np.array([token[:3] for token in tokens])
    sides = np.array([token[3] for token in tokens]) & layout.chiral
    corners = layout.corners(poses, sides)
    back = layout.poses(corners)
    np.testing.assert_allclose(back[:, :2], poses[:, :2], atol=1e-9)
    assert angle_gap(back[:, 2], poses[:, 2]).max() < 1e-9
    np.testing.assert_array_equal(layout.flipped(corners), sides)
    np.testing.assert_allclose(layout.bases(corners), poses[:, :2], atol=1e-9)


def test_fingerprint_tells_layouts_apart() -> None:
    pair = ("square", "small_triangle")
    others = [("small_triangle", "square"), ("square",), ("square", "medium_triangle")]
    same = [layout_of(*pair).fingerprint() for _ in range(2)]
    apart = [layout_of(*shapes).fingerprint() for shapes in others]
    assert len({*same, *apart, layout_of(*pair, scale=1.0).fingerprint()}) == 1 + 3 + 1


@pytest.mark.parametrize(
    ("shapes", "scale", "reason"),
    [
        ((), 1.0, "1 to 16 shapes, got 0"),
        (("square",) * 17, 1.0, "1 to 16 shapes, got 17"),
        (("square",), 0.0, r"tokens.scale must be between 1e-06 and 1e\+06, got 0"),
        (("square",), math.nan, "tokens.scale must be a finite number, .*, got nan"),
        (("hexagon",), 1.0, "unknown shape 'hexagon': choose from large_triangle"),
        (({"name": "own"},), 1.0, "keys name and corners"),
        ((3,), 1.0, "keys name and corners"),
        (({"name": "own", "corners": [[0, 0], [1, 1]]},), 1.0, "3 to 16 pairs"),
    ],
)
def test_refused_token_set(shapes: tuple[object, ...], scale: float, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        make_layout(TokensConfig(shapes, scale))
