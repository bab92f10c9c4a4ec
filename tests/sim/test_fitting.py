"""Hand-drawn figures become the exact ones that they stand for."""

import json
from collections.abc import Sequence
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_sim.arrays import Floats
from tangram_sim.fitting import VARIANTS, fit_piece, overlap_depths, separate
from tangram_sim.geometry import any_overlap
from tangram_sim.puzzles import load_puzzle, parse_puzzles
from tangram_sim.shapes import polygon_area, tan
from tests.sim.drawings import FIGURES, figure, file_of

pytestmark = pytest.mark.fast

NOISE = 0.01  # units, of a drawn coordinate


def moved(points: Floats, angle: float, shift: Sequence[float]) -> Floats:
    cos, sin = np.cos(angle), np.sin(angle)
    turned: Floats = points @ np.array([[cos, sin], [-sin, cos]]) + shift
    return turned


def same_corners(first: Floats, second: Floats) -> float:
    """The largest distance of corners (V, 2) that are the same in some order."""
    orders = permutations(range(len(first)))
    return min(float(np.linalg.norm(first - second[list(o)], axis=1).max()) for o in orders)


def redrawn(entry: dict, angle: float, shift: Sequence[float], seed: int, noise: float) -> None:
    """Turn and move a figure, put its corners and pieces in any order, shift each corner a bit."""
    rng = np.random.default_rng(seed)
    for piece in entry["pieces"]:
        corners = moved(np.array(piece["corners"]), angle, shift)
        rng.shuffle(corners)
        piece["corners"] = (corners + rng.uniform(-noise, noise, corners.shape)).tolist()
    rng.shuffle(entry["pieces"])


@settings(max_examples=60, deadline=None)
@given(
    name=st.sampled_from(sorted(FIGURES)),
    angle=st.floats(-10.0, 10.0),
    shift=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
    seed=st.integers(0, 2**32),
    noise=st.sampled_from([0.0, NOISE / 2, NOISE]),
)
def test_any_hand_drawn_figure_of_the_library_loads_close_to_the_true_one(
    name: str, angle: float, shift: tuple[float, float], seed: int, noise: float
) -> None:
    entry = figure(name)
    redrawn(entry, angle, shift, seed, noise)
    (loaded,) = parse_puzzles(json.dumps(file_of(entry)), "my.json").puzzles
    true = load_puzzle(name)
    assert loaded.pieces == true.pieces
    assert not any_overlap(loaded.corners[None], loaded.layout)[0]
    assert distance(loaded.corners, true, angle) < true.scale * (1e-6 if noise == 0.0 else 0.05)


def distance(corners: Floats, true: object, angle: float) -> float:
    """Of a loaded figure from the true one, turned; pieces of one kind may be swapped."""
    goal = moved(true.corners, angle, (0.0, 0.0))
    goal -= (goal.min(axis=0) + goal.max(axis=0)) / 2.0
    pieces = [true.layout.corners_of(k) for k in range(7)]
    gaps = np.array([[_gap(corners[one], goal[other]) for other in pieces] for one in pieces])
    straight, swapped = list(range(7)), [1, 0, 2, 4, 3, 5, 6]
    pairs = [(0, 1), (2,), (3, 4), (5,), (6,)]
    assert true.pieces[0] == true.pieces[1]
    assert true.pieces[3] == true.pieces[4]
    return max(
        min(max(gaps[k, order[k]] for k in group) for order in (straight, swapped))
        for group in pairs
    )


def _gap(first: Floats, second: Floats) -> float:
    return same_corners(first, second) if len(first) == len(second) else np.inf


@pytest.mark.parametrize("name", [name for names in VARIANTS.values() for name in names])
def test_every_order_of_corners_gives_the_exact_tan(name: str) -> None:
    kind = name.removesuffix("_mirrored")
    body = tan(name).corners
    drawn = moved(body, 2.5, (3.0, -4.0))
    for order in permutations(range(len(body))):
        fit = fit_piece(kind, drawn[list(order)])
        assert fit.shape == name
        assert fit.residual < 1e-12
        assert same_corners(moved(body, fit.pose[2], fit.pose[:2]), drawn) < 1e-12


def test_the_residual_is_the_largest_distance_of_a_corner() -> None:
    drawn = tan("square").corners.copy()
    out = 1.0 + 0.04 / np.linalg.norm(drawn[0])
    assert fit_piece("square", drawn * out).residual == pytest.approx(0.04)


def test_other_tans_fit_much_worse_than_a_drawing_may() -> None:
    for kind, (name, *_) in VARIANTS.items():
        for other in VARIANTS:
            if other != kind and len(tan(other).corners) == len(tan(name).corners):
                assert fit_piece(other, tan(name).corners).residual > 0.09


def squares(*middles: tuple[float, float]) -> Floats:
    unit = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) - 0.5
    return np.array([unit + middle for middle in middles])


def test_depths_of_overlap_and_the_way_out() -> None:
    depth, way = overlap_depths(squares((0, 0), (0.9, 0.2), (5, 0)))
    assert depth[0, 1] == depth[1, 0] == pytest.approx(0.1)
    np.testing.assert_allclose(way[0, 1], (1, 0))
    np.testing.assert_allclose(way[1, 0], (-1, 0))
    assert (depth[2] < 0).all()
    assert (np.diag(depth) == -np.inf).all()


def test_padding_by_repeated_corners_does_no_harm() -> None:
    triangle = np.array([(0, 0), (1, 0), (0, 1), (0, 1)])
    assert polygon_area(triangle) == 0.5
    depth, _ = overlap_depths(np.array([triangle, triangle + (0.4, 0.4)]))
    assert depth[0, 1] == pytest.approx(0.2 / np.sqrt(2.0))


def test_pieces_are_pushed_apart_and_not_further() -> None:
    drawn = squares((0, 0), (0.98, 0.01), (1.97, 0.0), (0.5, 0.99))
    shifts = separate(drawn)
    depth, _ = overlap_depths(drawn + shifts[:, None])
    assert depth.max() <= 1e-9
    assert np.abs(shifts).max() < 0.04
    np.testing.assert_array_equal(separate(drawn[:1]), [[0.0, 0.0]])
    apart = squares((0, 0), (1.0, 0.0), (3.0, 0.0))
    np.testing.assert_array_equal(separate(apart), np.zeros((3, 2)))
