"""Targets of every kind, and starts that keep clear of them."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from tangram_sim.assembly import Puzzle
from tangram_sim.config import SimConfig, StageConfig
from tangram_sim.errors import ConfigError
from tangram_sim.layout import Layout
from tangram_sim.puzzles import library
from tangram_sim.seeding import evaluation_generators
from tangram_sim.targets import check_targets, placement, sample_starts, sample_targets
from tests.sim.builders import SEVEN, TRIO, largest_overlap, layout_of, pieces

pytestmark = pytest.mark.fast

GAME = layout_of(*SEVEN, scale=0.6)
KINDS = ("uniform", "gaussian", "connected", "figures", "mixed")
PUZZLES = [*library("train"), *library("test")]


def union(layout: Layout, poses: np.ndarray, flipped: np.ndarray | None = None) -> shapely.Geometry:
    return shapely.union_all(pieces(layout, poses, flipped), grid_size=1e-9)


def reflected(shape: shapely.Geometry) -> shapely.Geometry:
    return shapely.transform(shape, lambda points: points * [1.0, -1.0])


def test_every_figure_of_the_library_is_laid_with_the_games_tokens() -> None:
    """And so is its mirror image; some need the parallelogram's other side."""
    turned_over = 0
    for puzzle in PUZZLES:
        poses, flipped = placement(puzzle, GAME)
        figure = union(puzzle.layout, puzzle.poses)
        assert union(GAME, poses, flipped).symmetric_difference(figure).area < 1e-7
        image = union(GAME, *GAME.mirrored(poses, flipped))
        assert image.symmetric_difference(reflected(figure)).area < 1e-7
        turned_over += bool(flipped.any())
    assert 0 < turned_over < len(PUZZLES)


def test_tokens_in_another_order_and_with_the_mirrored_piece_will_do() -> None:
    layout = layout_of("parallelogram_mirrored", *SEVEN[:6][::-1], scale=0.6)
    for puzzle in PUZZLES[:10]:
        poses, flipped = placement(puzzle, layout)
        figure = union(puzzle.layout, puzzle.poses)
        assert union(layout, poses, flipped).symmetric_difference(figure).area < 1e-7


@pytest.mark.parametrize(
    ("layout", "reason"),
    [
        (layout_of(*TRIO, scale=0.6), "has 7 pieces, and there are 3 tokens: set tokens=tangram7"),
        (layout_of(*SEVEN, "square", scale=0.6), "cannot be assembled .* set tokens=tangram7"),
        (layout_of(*SEVEN, scale=0.8), "of scale 0.6: .* tokens.scale=0.6"),
        (layout_of(*["square"] * 7, scale=0.6), "cannot be assembled from the tokens square, "),
    ],
)
def test_figures_of_other_tokens_are_refused(layout: Layout, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        placement(PUZZLES[0], layout)


def sampled(kind: str, count: int = 24, **settings: object) -> tuple[np.ndarray, np.ndarray]:
    sim = replace(SimConfig(targets=kind), **settings)  # type: ignore[arg-type]
    return sample_targets(GAME, sim, sim.task, evaluation_generators(count))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mirrored", [0.0, 0.5, 1.0])
def test_targets_lie_inside_and_apart(kind: str, mirrored: float) -> None:
    poses, flipped = sampled(kind, mirrored=mirrored)
    assert np.abs(GAME.corners(poses, flipped)).max() <= 1.0 + 1e-9
    for one, sides in zip(poses, flipped, strict=True):
        assert largest_overlap(GAME, one, sides) < 1e-7
    if kind != "figures":  # they need either side
        assert (not flipped.any(), bool(flipped[:, 6].all())) == (mirrored == 0.0, mirrored == 1.0)
    assert not flipped[:, :6].any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_target_depends_on_its_own_generator_only(kind: str) -> None:
    sim = SimConfig(targets=kind, mirrored=0.5, starts="outside", allow_flip=True)
    done = np.zeros((6, 7), dtype=np.bool_)

    def layouts(which: slice) -> list[np.ndarray]:
        generators = evaluation_generators(6)[which]
        targets = sample_targets(GAME, sim, sim.task, generators)
        return [*targets, *sample_starts(GAME, sim, targets, done[which], generators)]

    together = layouts(slice(0, 6))
    for b in range(6):
        for all_of_them, one in zip(together, layouts(slice(b, b + 1)), strict=True):
            np.testing.assert_array_equal(all_of_them[b], one[0])


def test_figures_are_those_of_the_train_split_turned() -> None:
    poses, flipped = sampled("figures", 40)
    areas = [union(p.layout, p.poses) for p in library("train")]
    rings = {round(shape.length, 5) for shape in areas}
    lengths = {round(union(GAME, *pair).length, 5) for pair in zip(poses, flipped, strict=True)}
    assert lengths <= rings
    assert len(lengths) > 10
    angles = poses[:, 5, 2]
    assert np.abs(angles).max() <= np.pi
    assert len(np.unique(np.round(angles, 3))) > 30


def test_mixed_is_uniform_and_connected_in_turns() -> None:
    poses, flipped = sampled("mixed", 60)
    whole = [
        union(GAME, *pair).buffer(1e-6).geom_type == "Polygon"
        for pair in zip(poses, flipped, strict=True)
    ]
    assert 15 < sum(whole) < 45


@pytest.mark.parametrize("spread", [0.05, 0.2])
def test_gaussian_centres_have_the_spread_that_was_asked_for(spread: float) -> None:
    layout = layout_of("small_triangle", scale=0.2)
    sim = SimConfig(targets="gaussian", spread=spread)
    poses, _ = sample_targets(layout, sim, sim.task, evaluation_generators(800))
    assert poses[..., :2].std() == pytest.approx(2.0 * spread, rel=0.1)
    assert np.abs(poses[..., :2].mean(axis=(0, 1))).max() < 0.05
    assert poses[..., 2].std() == pytest.approx(2.0 * np.pi / 12.0**0.5, rel=0.1)


def test_a_narrow_gaussian_widens_until_there_is_room() -> None:
    poses, _ = sampled("gaussian", 10, spread=0.001)
    for one in poses:
        assert largest_overlap(GAME, one) < 1e-8
    wide = np.abs(sampled("uniform", 10)[0][..., :2]).mean()
    assert np.abs(poses[..., :2]).mean() < 0.7 * wide


@pytest.mark.parametrize(
    ("layout", "sim", "reason"),
    [
        (GAME, SimConfig(targets="figures"), None),
        (GAME, SimConfig(allow_flip=True), None),
        (GAME, SimConfig(stages=(StageConfig(tokens=7),)), None),
        (layout_of(*TRIO), SimConfig(targets="figures"), "needs all seven tans, got tokens para"),
        (
            layout_of(*TRIO),
            SimConfig(stages=(StageConfig(targets="figures"),)),
            "sim.targets=figures needs all seven tans",
        ),
        (
            layout_of(*SEVEN, scale=0.8),
            SimConfig(targets="figures"),
            r"an arena of width 2\.48 for tokens.scale=0.8, got 2: raise sim.arena, or lower",
        ),
        (
            layout_of("square"),
            SimConfig(allow_flip=True),
            "allow_flip=true needs a token that is not .* got tokens square: set sim.allow_flip",
        ),
        (
            GAME,
            SimConfig(stages=(StageConfig(), StageConfig(updates=9, tokens=8))),
            r"at most the 7 that there are, got 8 \(in the stage from update 9\); 0 moves all",
        ),
    ],
)
def test_tasks_that_tokens_cannot_play(layout: Layout, sim: SimConfig, reason: str | None) -> None:
    if reason is None:
        check_targets(layout, sim)
        return
    with pytest.raises(ConfigError, match=reason):
        check_targets(layout, sim)


def starts_of(sim: SimConfig, layout: Layout, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(B, K, 3) starts, and (B,) the area of them that lies on the target."""
    generators = evaluation_generators(count)
    targets = sample_targets(layout, sim, sim.task, generators)
    done = np.zeros((count, layout.tokens), dtype=np.bool_)
    poses, sides = sample_starts(layout, sim, targets, done, generators)
    on = [
        union(layout, poses[b], sides[b])
        .intersection(union(layout, targets[0][b], targets[1][b]))
        .area
        for b in range(count)
    ]
    return np.concatenate([poses, sides[..., None]], axis=-1), np.array(on)


@pytest.mark.parametrize("kind", ["uniform", "connected", "figures"])
def test_starts_keep_clear_of_the_target_where_there_is_room(kind: str) -> None:
    sim = SimConfig(targets=kind, starts="outside", mirrored=0.5)
    assert starts_of(sim, GAME, 24)[1].max() < 1e-7
    assert starts_of(replace(sim, starts="anywhere"), GAME, 24)[1].max() > 0.01


def test_starts_lie_on_the_target_where_there_is_no_other_room() -> None:
    layout = layout_of("square", scale=2.0**0.5 * 2.0)  # a side of 1
    starts, on = starts_of(SimConfig(starts="outside", arena=1.6), layout, 12)
    assert on.min() > 0.0
    assert np.abs(layout.corners(starts[..., :3])).max() <= 0.8


def test_a_puzzle_is_unchanged_by_being_placed() -> None:
    puzzle: Puzzle = PUZZLES[0]
    before = puzzle.poses.copy()
    placement(puzzle, GAME)[0][:] = 9.0
    np.testing.assert_array_equal(puzzle.poses, before)
