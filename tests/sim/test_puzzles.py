"""The package's library of puzzles, and what a drawing must be to become one."""

import json
from collections import Counter
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from shapely import MultiPolygon, Polygon, unary_union

from tangram_sim.assembly import COUNTS, Puzzle, PuzzleRules
from tangram_sim.config import SimConfig
from tangram_sim.errors import ConfigError
from tangram_sim.geometry import any_overlap
from tangram_sim.puzzles import library, load_puzzle, parse_puzzles, puzzle_names
from tangram_sim.sampling import sample_poses
from tangram_sim.shapes import SHAPE_NAMES, tan
from tests.sim.drawings import SQUARE, figure, file_of

pytestmark = pytest.mark.fast

NAMES = [*puzzle_names("train"), *puzzle_names("test")]


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
    train, test = puzzle_names("train"), puzzle_names("test")
    assert len(train) >= 30
    assert len(test) >= 12
    assert len({*train, *test, *puzzle_names("paper")}) == len(puzzle_names())
    assert puzzle_names("paper") == ["cat_of_six"]
    assert puzzle_names() == [*train, *test, "cat_of_six"]


@pytest.mark.parametrize("name", NAMES)
def test_a_figure_is_made_of_all_seven_tans_and_fits_the_arena_however_turned(name: str) -> None:
    puzzle = load_puzzle(name)
    kinds = Counter(piece.removesuffix("_mirrored") for piece in puzzle.pieces)
    assert kinds == COUNTS
    assert list(puzzle.pieces) == sorted(puzzle.pieces, key=SHAPE_NAMES.index)
    assert puzzle.poses.shape == (7, 3)
    assert not any_overlap(puzzle.corners[None], puzzle.layout)[0]
    pieces = outlines(puzzle)
    for piece, shape in zip(pieces, puzzle.pieces, strict=True):
        assert piece.area == pytest.approx(tan(shape).area, abs=1e-9)
    # Without a grid, shapely takes some pieces that only touch for one inside the other.
    assert unary_union(pieces, grid_size=1e-9).area == pytest.approx(1.0, abs=1e-6)
    low, high = puzzle.corners.min(axis=0), puzzle.corners.max(axis=0)
    np.testing.assert_allclose(low + high, 0.0, atol=1e-12)
    apart = [np.linalg.norm(a - b) for a, b in combinations(puzzle.corners / puzzle.scale, 2)]
    assert max(apart) <= 3.1


@pytest.mark.parametrize("name", NAMES)
def test_every_piece_touches_another_along_an_edge_or_at_a_corner(name: str) -> None:
    pieces = outlines(load_puzzle(name))
    alone = [
        k
        for k, piece in enumerate(pieces)
        if not any(piece.distance(other) < 1e-6 for other in pieces if other is not piece)
    ]
    assert len(alone) <= (1 if name in ("exclamation_mark", "sun_over_mountains") else 0)


@pytest.mark.parametrize("name", puzzle_names("train"))
def test_figures_to_train_on_hang_together_without_holes(name: str) -> None:
    whole = silhouette(load_puzzle(name))
    assert len(whole.geoms) == 1
    assert not [hole for hole in whole.geoms[0].interiors if Polygon(hole).area > 1e-6]


def test_figures_to_test_on_have_holes_and_several_areas() -> None:
    holes, areas = [], []
    for puzzle in library("test"):
        whole = silhouette(puzzle)
        if len(whole.geoms) > 1:
            areas.append(puzzle.name)
        if any(Polygon(hole).area > 1e-3 for part in whole.geoms for hole in part.interiors):
            holes.append(puzzle.name)
    assert holes == ["hut", "lantern"]
    assert areas == ["exclamation_mark", "sun_over_mountains", "two_squares"]


def test_no_two_figures_are_the_same() -> None:
    shapes = {name: silhouette(load_puzzle(name)) for name in NAMES}
    for (one, first), (other, second) in combinations(shapes.items(), 2):
        assert first.symmetric_difference(second).area > 0.05, (one, other)


def test_both_parallelograms_are_in_both_splits() -> None:
    for split in ("train", "test"):
        names = Counter(puzzle.pieces[-1] for puzzle in library(split))
        assert min(names["parallelogram"], names["parallelogram_mirrored"]) >= 3


def test_the_full_square_is_one_of_them() -> None:
    square = silhouette(load_puzzle("square", scale=1.0))
    assert square.symmetric_difference(Polygon(np.array(SQUARE) - 0.5)).area < 1e-5


def test_the_papers_cat_has_six_tokens_and_fits_the_default_arena() -> None:
    cat = load_puzzle("cat_of_six", scale=0.8)
    assert Counter(cat.pieces) == Counter(
        large_triangle=2, small_triangle=2, square=1, parallelogram_mirrored=1
    )
    assert np.abs(cat.corners).max() < SimConfig().arena / 2.0
    sim = SimConfig(backend="kinematic")
    poses = sample_poses(cat.layout, sim, np.random.default_rng(0))
    assert not any_overlap(cat.layout.corners(poses)[None], cat.layout)[0]


def test_an_unknown_puzzle_or_split_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(ConfigError, match="unknown puzzle 'unicorn': choose from square, rect"):
        load_puzzle("unicorn")
    with pytest.raises(ConfigError, match="unknown split 'all': choose from train, test, paper"):
        library("all")


# What a drawing must be


def refused(content: dict[str, Any], rules: PuzzleRules | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_puzzles(json.dumps(content), "my.json", rules)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_missing_and_superfluous_pieces_are_counted() -> None:
    short = figure("cat")
    short["pieces"][0] = short["pieces"].pop()
    message = refused(file_of(short))
    kinds = Counter(piece["shape"] for piece in short["pieces"])
    wrong = [f"{kinds[kind]} {kind} (must be {n})" for kind, n in COUNTS.items() if kinds[kind] < n]
    assert message == f"puzzle 'cat': has {', '.join(wrong)}: draw each of the seven tans"


def test_a_subset_is_allowed_only_when_asked_for() -> None:
    few = figure("cat")
    few["pieces"] = few["pieces"][:3]
    assert "draw each of the seven tans" in refused(file_of(few))
    rules = PuzzleRules(subset=True)
    (puzzle,) = parse_puzzles(json.dumps(file_of(few)), "my.json", rules).puzzles
    assert len(puzzle.pieces) == 3
    squares = [piece for piece in few["pieces"] if piece["shape"] == "square"]
    few["pieces"] = squares * 2
    assert refused(file_of(few), rules) == (
        "puzzle 'cat': has 2 square (must be at most 1): draw some of the seven tans"
    )


def test_a_piece_of_the_wrong_size_is_named_with_its_residual() -> None:
    wrong = figure("square")
    piece = wrong["pieces"][2]
    piece["corners"] = (2.0 * np.array(piece["corners"])).tolist()
    assert refused(file_of(wrong)) == (
        "puzzle 'square', piece 3 (small_triangle): a corner is 0.264 units off the exact shape, "
        "at most 0.03 allowed: it is 2 times as large as it should be; draw the full square with "
        "side 1"
    )


def test_pieces_that_overlap_are_named_with_their_depth() -> None:
    wrong = figure("square")
    small = wrong["pieces"][2]
    small["corners"] = (np.array(small["corners"]) - (0.1, 0.0)).tolist()
    assert refused(file_of(wrong)) == (
        "puzzle 'square', piece 1 (large_triangle): lies 0.0707 units deep in piece 3 "
        "(small_triangle), at most 0.04 allowed: move them apart; "
        "puzzle 'square', piece 3 (small_triangle): lies 0.0707 units deep in piece 4 (square), "
        "at most 0.04 allowed: move them apart"
    )


def test_small_overlaps_are_pushed_apart() -> None:
    loose = figure("square")
    small = loose["pieces"][2]
    small["corners"] = (np.array(small["corners"]) - (0.02, 0.0)).tolist()
    (puzzle,) = parse_puzzles(json.dumps(file_of(loose)), "my.json").puzzles
    assert not any_overlap(puzzle.corners[None], puzzle.layout)[0]
    exact = load_puzzle("square")
    assert 1e-3 < np.abs(puzzle.corners - exact.corners).max() < 0.03 * puzzle.scale


def test_a_figure_must_fit_the_arena() -> None:
    wide = figure("square")
    last = wide["pieces"][-1]
    last["corners"] = (np.array(last["corners"]) + (0.0, 3.0)).tolist()
    message = refused(file_of(wide))
    assert message.startswith("puzzle 'square': is 4")
    assert message.endswith("units across, at most 3.1 allowed: draw it closer")
    rules = PuzzleRules(max_extent=10.0)
    assert parse_puzzles(json.dumps(file_of(wide)), "my.json", rules).puzzles


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"scale": 0.0}, "scale of puzzles must be between 0.001 and 1000, got 0.0"),
        ({"scale": float("nan")}, "scale of puzzles must be between 0.001 and 1000, got nan"),
        ({"max_extent": 0.5}, "max_extent of puzzles must be between 1 and 1000, got 0.5"),
    ],
)
def test_rules_out_of_range_are_refused(rules: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PuzzleRules(**rules)
