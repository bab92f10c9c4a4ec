"""Targets of every kind, and starts that keep clear of them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely

from tangram_core.errors import ConfigError
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import overlap_area
from tangram_sim.puzzles.figures import library
from tangram_sim.targets.targets import check_targets, placement, sample_starts, sample_targets
from tests.sim.builders import (
    SEVEN,
    TRIO,
    evaluation_generators,
    largest_overlap,
    layout_of,
    pieces,
)

pytestmark = pytest.mark.fast

GAME = layout_of(*SEVEN, scale=0.6)
TRIPLE = layout_of(*TRIO, scale=0.6)
SEEN = {"observe": "pictures", "pixels": 64}
SIDE = 0.125**0.5  # of the square tan, whose full square is 1
BOX = {"name": "box", "corners": [[0, 0], [SIDE, 0], [SIDE, SIDE], [0, SIDE]]}
KINDS = ("uniform", "connected", "figures", "touching")
PUZZLES = [*library("train"), *library("test")]


def union(layout: Layout, poses: np.ndarray, flipped: np.ndarray | None = None) -> shapely.Geometry:
    return shapely.union_all(pieces(layout, poses, flipped), grid_size=1e-9)


def test_every_figure_of_the_library_is_laid_with_the_games_tokens() -> None:
    """And so is its mirror image; some need the parallelogram's other side."""
    turned_over = 0
    other = layout_of("parallelogram_mirrored", *SEVEN[:6][::-1], scale=0.6)
    for puzzle in PUZZLES:
        before, figure = puzzle.poses.copy(), union(puzzle.layout, puzzle.poses)
        reflected = shapely.transform(figure, lambda points: points * [1.0, -1.0])
        poses, flipped = placement(puzzle, GAME)
        assert union(GAME, poses, flipped).symmetric_difference(figure).area < 1e-7
        image = union(GAME, *GAME.mirrored(poses, flipped))
        assert image.symmetric_difference(reflected).area < 1e-7
        turned_over += bool(flipped.any())
        # Tokens in another order and with the mirrored piece will do.
        laid = union(other, *placement(puzzle, other))
        assert laid.symmetric_difference(figure).area < 1e-7
        poses[:] = 9.0
        np.testing.assert_array_equal(puzzle.poses, before)
    assert 0 < turned_over < len(PUZZLES)


@pytest.mark.parametrize(
    ("layout", "reason"),
    [
        (TRIPLE, "has 7 pieces, and there are 3 tokens: set tokens=tangram7"),
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
    return sample_targets(GAME, sim, evaluation_generators(count))


def begun(count: int = 12, **sim: Any) -> BatchedEnv:
    env = BatchedEnv(GAME, SimConfig(backend="kinematic", **sim), RewardConfig(), count)
    env.reset(evaluation_generators(count))
    return env


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mirrored", [0.0, 0.5, 1.0])
def test_targets_lie_inside_and_apart(kind: str, mirrored: float) -> None:
    poses, flipped = sampled(kind, mirrored=mirrored)
    assert np.abs(GAME.corners(poses, flipped)).max() <= 1.0 + 1e-9
    for one, sides in zip(poses, flipped, strict=True):
        assert largest_overlap(GAME, one, sides) < 1e-7
    if kind not in ("figures", "touching"):  # figures need either side
        assert (not flipped.any(), bool(flipped[:, 6].all())) == (mirrored == 0.0, mirrored == 1.0)
    assert not flipped[:, :6].any()


@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_depends_on_its_own_generator_only(kind: str) -> None:
    """Rejected draws of one environment do not shift the others."""
    settings = {"targets": kind, "mirrored": 0.5, "allow_flip": True}
    together, alone = (begun(n, starts="outside", **settings) for n in (6, 1))
    for b, generator in enumerate(evaluation_generators(6)):
        alone.reset([generator])
        for name in ("goals", "corners", "placed"):
            np.testing.assert_array_equal(getattr(together, name)[b], getattr(alone, name)[0])


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


def test_touching_is_connected_and_figures_in_turns() -> None:
    rings = {round(union(p.layout, p.poses).length, 5) for p in library("train")}
    drawn = 0
    for pair in zip(*sampled("touching", 60), strict=True):
        area = union(GAME, *pair)
        figure = round(area.length, 5) in rings
        assert figure or area.buffer(1e-6).geom_type == "Polygon"
        drawn += figure
    assert 15 < drawn < 45


@pytest.mark.parametrize(
    ("layout", "settings", "reason"),
    [
        (TRIPLE, {"targets": "figures"}, "figures needs all seven tans, got tokens para"),
        (TRIPLE, {"targets": "touching"}, "touching needs all seven tans, got tokens para"),
        (
            layout_of(*SEVEN, scale=0.8),
            {"targets": "figures"},
            r"an arena of width 2\.48 for tokens.scale=0.8, got 2: raise sim.arena, or lower",
        ),
        (
            GAME,
            {"targets": "connected", "observe": "pictures", "pixels": 64},
            "pictures can tell at most 3 .* got 7 with sim.targets=connected: set sim.targets",
        ),
        (
            layout_of("parallelogram", "parallelogram_mirrored"),
            SEEN,
            "cannot tell parallelogram from parallelogram_mirrored, which may look alike: leave ",
        ),
        (layout_of("square", BOX), SEEN, "cannot tell square from box, which may look alike: "),
        (
            layout_of(BOX, BOX | {"corners": [[0, 0], [1, 0], [1, 2], [0, 2]]}),
            SEEN,
            "needs equal corners for tokens of one name, and two tokens box differ: give them diff",
        ),
        (
            layout_of(BOX, BOX | {"corners": [[0, 0], [0.25, 0.25], [0, 0.5], [-0.25, 0.25]]}),
            SEEN,
            "needs equal corners for tokens of one name, and two tokens box differ: give them the ",
        ),
        (
            layout_of("square"),
            {"allow_flip": True},
            "allow_flip=true needs a token that is not .* got tokens square: set sim.allow_flip",
        ),
        (
            layout_of("square", scale=0.01),
            {},
            "'square' must be at least 0.002 thick .* got 0.00177",
        ),
    ],
)
def test_tasks_that_tokens_cannot_play(
    layout: Layout, settings: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        check_targets(layout, SimConfig(**settings))


def starts_of(sim: SimConfig, layout: Layout, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(B, K, 3) starts, and (B,) the area of them that lies on the target."""
    generators = evaluation_generators(count)
    targets = sample_targets(layout, sim, generators)
    starts = sample_starts(layout, sim, targets, generators)
    np.testing.assert_array_equal(starts[1], targets[1])  # always within reach
    corners, goals = layout.corners(*starts), layout.corners(*targets)
    return starts[0], overlap_area(corners, goals, layout)


@pytest.mark.parametrize("kind", ["uniform", "connected", "figures"])
def test_starts_keep_clear_of_the_target_where_there_is_room(kind: str) -> None:
    sim = SimConfig(targets=kind, starts="outside", mirrored=0.5)
    assert starts_of(sim, GAME, 24)[1].max() < 1e-7
    assert starts_of(replace(sim, starts="anywhere"), GAME, 24)[1].max() > 0.01


def test_starts_lie_on_the_target_where_there_is_no_other_room() -> None:
    layout = layout_of("square", scale=2.0**0.5 * 2.0)  # a side of 1
    starts, on = starts_of(SimConfig(starts="outside", arena=1.6), layout, 12)
    assert on.min() > 0.0
    assert np.abs(layout.corners(starts)).max() <= 0.8


def test_given_targets_are_played() -> None:
    env, other = begun(), begun(targets="figures", mirrored=0.5)
    poses, sides = GAME.poses(other.goals), GAME.flipped(other.goals)
    env.reset(evaluation_generators(12), (poses, sides))
    np.testing.assert_allclose(env.goals, other.goals, atol=1e-9)
    assert env.steps_done == 0
    with pytest.raises(ValueError, match="need 12 generators, got 3"):
        env.reset(evaluation_generators(3), (poses, sides))
