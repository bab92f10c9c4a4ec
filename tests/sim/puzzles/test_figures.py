"""The package's library of puzzles, and drawings that become exact figures or are refused."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from itertools import combinations, permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import MultiPolygon, Polygon, unary_union

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.config import SimConfig
from tangram_sim.geometry.fitting import VARIANTS, fit_piece, overlap_depths, separate
from tangram_sim.geometry.shapes import SHAPE_NAMES, polygon_area, tan
from tangram_sim.puzzles.assembly import COUNTS, Puzzle, PuzzleRules
from tangram_sim.puzzles.figures import SPLITS, library, load_puzzle, parse_puzzles
from tests.sim.builders import largest_overlap, sample_poses
from tests.sim.puzzles.drawings import FIGURES, distance, figure, file_of, moved, same_corners

pytestmark = pytest.mark.fast

NAMES = {split: [puzzle.name for puzzle in library(split)] for split in SPLITS}
GAME = [*NAMES["train"], *NAMES["test"]]
NOISE = 0.01  # units, of a drawn coordinate


def outlines(puzzle: Puzzle) -> list[Polygon]:
    """In units, the side of the full square."""
    corners = puzzle.corners / puzzle.scale
    return [Polygon(corners[puzzle.layout.corners_of(k)]) for k in range(len(puzzle.pieces))]


def silhouette(puzzle: Puzzle) -> Any:
    """Gaps and bridges of rounding closed."""
    whole = unary_union([one.buffer(1e-6, join_style="mitre") for one in outlines(puzzle)])
    return whole if isinstance(whole, MultiPolygon) else MultiPolygon([whole])


# The library


def test_the_library_is_split_by_name() -> None:
    assert len(NAMES["train"]) >= 30
    assert len(NAMES["test"]) >= 12
    assert NAMES["paper"] == ["cat_of_six"]
    names = [puzzle.name for puzzle in library()]
    assert names == [*GAME, "cat_of_six"]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("name", GAME)
def test_a_figure_is_made_of_all_seven_tans_and_fits_the_arena_however_turned(name: str) -> None:
    puzzle = load_puzzle(name)
    kinds = Counter(piece.removesuffix("_mirrored") for piece in puzzle.pieces)
    assert kinds == COUNTS
    assert list(puzzle.pieces) == sorted(puzzle.pieces, key=SHAPE_NAMES.index)
    assert puzzle.poses.shape == (7, 3)
    pieces = outlines(puzzle)
    for piece, shape in zip(pieces, puzzle.pieces, strict=True):
        assert piece.area == pytest.approx(tan(shape).area, abs=1e-9)
    assert largest_overlap(puzzle.layout, puzzle.poses) < 1e-8
    # Without a grid, shapely takes some pieces that only touch for one inside the other.
    assert unary_union(pieces, grid_size=1e-9).area == pytest.approx(1.0, abs=1e-6)
    low, high = puzzle.corners.min(axis=0), puzzle.corners.max(axis=0)
    np.testing.assert_allclose(low + high, 0.0, atol=1e-12)
    apart = [np.linalg.norm(a - b) for a, b in combinations(puzzle.corners / puzzle.scale, 2)]
    assert max(apart) <= 3.1
    touched = [
        any(one.distance(other) < 1e-6 for other in pieces if other is not one) for one in pieces
    ]
    assert touched.count(False) <= (name in ("exclamation_mark", "sun_over_mountains"))


@pytest.mark.parametrize("name", NAMES["train"])
def test_figures_to_train_on_hang_together_without_holes(name: str) -> None:
    whole = silhouette(load_puzzle(name))
    assert len(whole.geoms) == 1
    assert not [hole for hole in whole.geoms[0].interiors if Polygon(hole).area > 1e-6]


def test_no_two_figures_are_the_same() -> None:
    shapes = {name: silhouette(load_puzzle(name)) for name in GAME}
    for (one, first), (other, second) in combinations(shapes.items(), 2):
        assert first.symmetric_difference(second).area > 0.05, (one, other)


def test_the_papers_cat_has_six_tokens_and_fits_the_default_arena() -> None:
    cat = load_puzzle("cat_of_six", scale=0.8)
    tans = {"large_triangle": 2, "small_triangle": 2, "square": 1, "parallelogram_mirrored": 1}
    assert Counter(cat.pieces) == tans
    assert np.abs(cat.corners).max() < SimConfig().arena / 2.0
    poses = sample_poses(cat.layout, SimConfig(), np.random.default_rng(0))
    assert largest_overlap(cat.layout, poses) < 1e-8


def test_an_unknown_puzzle_or_split_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(ConfigError, match="unknown puzzle 'unicorn': choose from square, rect"):
        load_puzzle("unicorn")
    with pytest.raises(ConfigError, match="unknown split 'all': choose from train, test, paper"):
        library("all")


# Hand-drawn figures become the exact ones


def redrawn(entry: dict, angle: float, shift: Sequence[float], seed: int, noise: float) -> None:
    """Turn and move a figure, put its corners and pieces in any order, shift each corner a bit."""
    rng = np.random.default_rng(seed)
    for piece in entry["pieces"]:
        corners = moved(np.array(piece["corners"]), angle, shift)
        rng.shuffle(corners)
        piece["corners"] = (corners + rng.uniform(-noise, noise, corners.shape)).tolist()
    rng.shuffle(entry["pieces"])


@settings(max_examples=40)
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
    (loaded,) = parse_puzzles(json.dumps(file_of(entry)), "my.json")
    true = load_puzzle(name)
    assert loaded.pieces == true.pieces
    assert largest_overlap(loaded.layout, loaded.poses) < 1e-8
    assert distance(loaded.corners, true, angle) < true.scale * (1e-6 if noise == 0.0 else 0.05)


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
    np.testing.assert_allclose([way[0, 1], way[1, 0]], [(1, 0), (-1, 0)])
    assert (depth[2] < 0).all()
    assert (np.diag(depth) == -np.inf).all()
    padded = np.array([(0, 0), (1, 0), (0, 1), (0, 1)])  # a repeated corner does no harm
    assert polygon_area(padded) == 0.5
    assert overlap_depths(np.array([padded, padded + 0.4]))[0][0, 1] == pytest.approx(0.2 / 2**0.5)


def test_pieces_are_pushed_apart_and_not_further() -> None:
    drawn = squares((0, 0), (0.98, 0.01), (1.97, 0.0), (0.5, 0.99))
    shifts = separate(drawn)
    depth, _ = overlap_depths(drawn + shifts[:, None])
    assert depth.max() <= 1e-9
    assert np.abs(shifts).max() < 0.04
    np.testing.assert_array_equal(separate(drawn[:1]), [[0.0, 0.0]])
    apart = squares((0, 0), (1.0, 0.0), (3.0, 0.0))
    np.testing.assert_array_equal(separate(apart), np.zeros((3, 2)))


# What a drawing must be


def refused(content: dict[str, Any], rules: PuzzleRules | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_puzzles(json.dumps(content), "my.json", rules)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# Figure, changes of pieces (number -> factor, shift along x and y), what is told.
REFUSED = [
    (
        {2: (2.0, 0.0, 0.0)},
        "puzzle 'square', piece 3 (small_triangle): a corner is 0.264 units off the exact shape, "
        "at most 0.03 allowed: it is 2 times as large as it should be; draw the full square with "
        "side 1",
    ),
    (
        {2: (1.0, -0.1, 0.0)},
        "puzzle 'square', piece 1 (large_triangle): lies 0.0707 units deep in piece 3 "
        "(small_triangle), at most 0.04 allowed: move them apart; "
        "puzzle 'square', piece 3 (small_triangle): lies 0.0707 units deep in piece 4 (square), "
        "at most 0.04 allowed: move them apart",
    ),
    (
        {6: (1.0, 0.0, 3.0)},
        "puzzle 'square': is 4.123 units across, at most 3.1 allowed: draw it closer",
    ),
]


def changed(changes: dict[int, tuple[float, float, float]]) -> dict[str, Any]:
    """The full square with changed pieces."""
    entry = figure("square")
    for number, (factor, *shift) in changes.items():
        piece = entry["pieces"][number]
        piece["corners"] = (factor * np.array(piece["corners"]) + shift).tolist()
    return file_of(entry)


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_a_piece_that_does_not_fit_is_named_with_its_measure(
    changes: dict[int, tuple[float, float, float]], message: str
) -> None:
    assert refused(changed(changes)) == message


def test_pieces_are_counted_and_a_subset_is_allowed_only_when_asked_for() -> None:
    cat, rules = figure("cat"), PuzzleRules(subset=True)
    own, told = cat["pieces"], "draw each of the seven tans"
    kinds = [piece["shape"] for piece in own]
    square, other = own[kinds.index("square")], own[kinds.index("parallelogram")]
    cat["pieces"] = [piece for piece in own if piece is not other] + [square]
    missing = "has 2 square (must be 1), 0 parallelogram (must be 1)"
    assert refused(file_of(cat)) == f"puzzle 'cat': {missing}: {told}"
    cat["pieces"] = own[:3]
    assert told in refused(file_of(cat))
    (puzzle,) = parse_puzzles(json.dumps(file_of(cat)), "my.json", rules)
    assert len(puzzle.pieces) == 3
    cat["pieces"] = [square] * 2
    assert refused(file_of(cat), rules) == (
        "puzzle 'cat': has 2 square (must be at most 1): draw some of the seven tans"
    )


def test_rules_may_be_wider_within_their_range() -> None:
    wide = json.dumps(changed({6: (1.0, 0.0, 3.0)}))
    assert parse_puzzles(wide, "my.json", PuzzleRules(max_extent=10.0))
    for rule, value, low in (
        ("scale", 0.0, 0.001),
        ("scale", math.nan, 0.001),
        ("max_extent", 0.5, 1),
    ):
        message = f"{rule} of puzzles must be .*between {low} and 1000, got {value}"
        with pytest.raises(ConfigError, match=message):
            PuzzleRules(**{rule: value})
