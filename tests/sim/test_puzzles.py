"""Puzzles of the package: whole figures, and files that are none."""

import json

import numpy as np
import pytest
from shapely import Polygon, unary_union

from tangram_sim.config import SimConfig
from tangram_sim.errors import ConfigError
from tangram_sim.geometry import any_overlap
from tangram_sim.puzzles import PACKAGED, Puzzle, load_puzzle, parse_puzzle, puzzle_names
from tangram_sim.sampling import sample_poses

pytestmark = pytest.mark.fast


def pieces(puzzle: Puzzle) -> list[Polygon]:
    return [
        Polygon(puzzle.corners[puzzle.layout.corners_of(k)]) for k in range(puzzle.layout.tokens)
    ]


@pytest.mark.parametrize("name", puzzle_names())
def test_a_figure_has_no_overlap_and_hangs_together_by_edges(name: str) -> None:
    puzzle = load_puzzle(name)
    assert not any_overlap(puzzle.corners[None], puzzle.layout)[0]
    outlines = pieces(puzzle)
    whole = unary_union(outlines)
    assert whole.area == pytest.approx(sum(one.area for one in outlines), abs=1e-9)
    # A figure that only hangs together by corners would fall apart here.
    shrunk = unary_union([one.buffer(1e-6, join_style="mitre") for one in outlines]).buffer(-1e-3)
    assert shrunk.geom_type == "Polygon"


def test_the_cat_is_the_papers_six_tokens_in_the_default_arena() -> None:
    cat = load_puzzle("cat")
    assert cat.layout.tokens == 6
    names = sorted(shape.name for shape in cat.layout.shapes)
    assert names.count("small_triangle") == 2  # the ears
    assert "square" in names  # the head
    assert cat.arena == SimConfig().arena
    low, high = cat.corners.min(axis=0), cat.corners.max(axis=0)
    np.testing.assert_allclose(low + high, 0.0, atol=1e-9)


def test_a_start_of_the_cat_can_be_sampled() -> None:
    cat = load_puzzle("cat")
    sim = SimConfig(backend="kinematic", arena=cat.arena)
    poses = sample_poses(cat.layout, sim, np.random.default_rng(0))
    assert not any_overlap(cat.layout.corners(poses)[None], cat.layout)[0]


def test_an_unknown_puzzle_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(ConfigError, match="unknown puzzle 'dog': choose from cat"):
        load_puzzle("dog")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda cat: cat.pop("title"), "must have the keys arena, name, scale, title, tokens"),
        (lambda cat: cat.update(tokens={}), "tokens must be a list"),
        (lambda cat: cat["tokens"][0].update(z=1), "mappings with the keys angle, shape, x, y"),
        (
            lambda cat: cat["tokens"][0].update(x="1"),
            "x of token 0 of puzzle 'wrong' must be a fin",
        ),
        (lambda cat: cat["tokens"][5].update(angle=None), "angle of token 5"),
        (lambda cat: cat["tokens"][1].update(y=float("nan")), "finite number, got nan"),
        (lambda cat: cat["tokens"][1].update(shape="blob"), "unknown shape 'blob'"),
        (lambda cat: cat.update(scale=-1.0), "scale must be positive"),
        (lambda cat: cat["tokens"].clear(), "1 to 16 shapes"),
        (lambda cat: cat["tokens"][5].update(x=0.3), "tokens of puzzle 'cat' overlap"),
        (lambda cat: cat.update(arena=1.0), "further than half of its arena of width 1"),
    ],
)
def test_a_wrong_file_is_refused(change: object, message: str) -> None:
    content = json.loads((PACKAGED / "cat.json").read_text())
    change(content)
    with pytest.raises(ConfigError, match=message) as caught:
        parse_puzzle(json.dumps(content), "wrong")
    assert "\n" not in str(caught.value)


def test_what_is_no_json_is_refused() -> None:
    with pytest.raises(ConfigError, match="'wrong' is not JSON"):
        parse_puzzle("{", "wrong")
