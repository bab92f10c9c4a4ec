"""Targets of every kind, starts that keep clear of them, and the stages of a curriculum."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely

from tangram_sim.arrays import Bools
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig, StageConfig
from tangram_sim.errors import ConfigError
from tangram_sim.geometry import overlap_area
from tangram_sim.layout import Layout
from tangram_sim.puzzles import library
from tangram_sim.seeding import evaluation_generators
from tangram_sim.targets import check_targets, placement, sample_starts, sample_targets
from tests.sim.builders import SEVEN, TRIO, largest_overlap, layout_of, pieces

pytestmark = pytest.mark.fast

GAME = layout_of(*SEVEN, scale=0.6)
TRIPLE = layout_of(*TRIO, scale=0.6)
SEEN = {"observe": "pictures", "pixels": 64}
SIDE = 0.125**0.5  # of the square tan, whose full square is 1
BOX = {"name": "box", "corners": [[0, 0], [SIDE, 0], [SIDE, SIDE], [0, SIDE]]}
KINDS = ("uniform", "gaussian", "connected", "figures", "touching", "mixed")
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
    return sample_targets(GAME, sim, sim.task, evaluation_generators(count))


def begun(task: StageConfig, count: int = 12, **sim: Any) -> BatchedEnv:
    env = BatchedEnv(GAME, SimConfig(backend="kinematic", **sim), RewardConfig(), count)
    env.task = task
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
@pytest.mark.parametrize("tokens", [0, 3])
def test_an_episode_depends_on_its_own_generator_only(kind: str, tokens: int) -> None:
    """Rejected draws of one environment do not shift the others."""
    task, settings = StageConfig(tokens=tokens, targets=kind), {"mirrored": 0.5, "allow_flip": True}
    together, alone = (begun(task, n, starts="outside", **settings) for n in (6, 1))
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


def test_mixed_is_uniform_and_connected_in_turns() -> None:
    poses, flipped = sampled("mixed", 60)
    whole = [
        union(GAME, *pair).buffer(1e-6).geom_type == "Polygon"
        for pair in zip(poses, flipped, strict=True)
    ]
    assert 15 < sum(whole) < 45


def test_touching_is_connected_and_figures_in_turns() -> None:
    rings = {round(union(p.layout, p.poses).length, 5) for p in library("train")}
    drawn = 0
    for pair in zip(*sampled("touching", 60), strict=True):
        area = union(GAME, *pair)
        figure = round(area.length, 5) in rings
        assert figure or area.buffer(1e-6).geom_type == "Polygon"
        drawn += figure
    assert 15 < drawn < 45


@pytest.mark.parametrize("spread", [0.05, 0.2])
def test_gaussian_centres_have_the_spread_that_was_asked_for(spread: float) -> None:
    layout = layout_of("small_triangle", scale=0.2)
    sim = SimConfig(targets="gaussian", spread=spread)
    poses, _ = sample_targets(layout, sim, sim.task, evaluation_generators(800))
    assert poses[..., :2].std() == pytest.approx(2.0 * spread, rel=0.1)
    assert np.abs(poses[..., :2].mean(axis=(0, 1))).max() < 0.05
    assert poses[..., 2].std() == pytest.approx(2.0 * np.pi / 12.0**0.5, rel=0.1)


def test_a_narrow_gaussian_widens_until_there_is_room() -> None:
    poses, _ = sampled("gaussian", 5, spread=0.001)
    assert max(largest_overlap(GAME, one) for one in poses) < 1e-8
    wide = np.abs(sampled("uniform", 5)[0][..., :2]).mean()
    assert np.abs(poses[..., :2]).mean() < 0.7 * wide


@pytest.mark.parametrize(
    ("layout", "settings", "reason"),
    [
        (TRIPLE, {"targets": "figures"}, "figures needs all seven tans, got tokens para"),
        (TRIPLE, {"targets": "touching"}, "touching needs all seven tans, got tokens para"),
        (TRIPLE, {"stages": (StageConfig(targets="figures"),)}, "figures needs all seven tans"),
        (
            layout_of(*SEVEN, scale=0.8),
            {"targets": "figures"},
            r"an arena of width 2\.48 for tokens.scale=0.8, got 2: raise sim.arena, or lower",
        ),
        (
            GAME,
            {"targets": "mixed", "observe": "pictures", "pixels": 64},
            "pictures tells at most 3 tokens .* got 7 in sim.targets=mixed: set sim.targets",
        ),
        (
            layout_of("parallelogram", "parallelogram_mirrored"),
            SEEN,
            "cannot tell parallelogram from parallelogram_mirrored, which may look alike: take ",
        ),
        (layout_of("square", BOX), SEEN, "cannot tell square from box, which may look alike: "),
        (
            layout_of(BOX, BOX | {"corners": [[0, 0], [1, 0], [1, 2], [0, 2]]}),
            SEEN,
            "takes tokens of one name for equal, and two of box have other corners: give them ",
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
        (
            GAME,
            {"stages": (StageConfig(), StageConfig(updates=9, tokens=8))},
            r"at most the 7 that there are, got 8 \(in the stage from update 9\); 0 moves all",
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
    targets = sample_targets(layout, sim, sim.task, generators)
    done = np.zeros((count, layout.tokens), dtype=np.bool_)
    starts = sample_starts(layout, sim, targets, done, generators)
    np.testing.assert_array_equal(starts[1], targets[1])  # always within reach
    corners, goals = layout.corners(*starts), layout.corners(*targets)
    return starts[0], overlap_area(corners, goals, layout)


@pytest.mark.parametrize("starts", ["outside", "piles"])
@pytest.mark.parametrize("kind", ["uniform", "connected", "figures"])
def test_starts_keep_clear_of_the_target_where_there_is_room(kind: str, starts: str) -> None:
    sim = SimConfig(
        targets=kind, starts=starts, mirrored=0.5, arena=2.5 if starts == "piles" else 2.0
    )
    assert starts_of(sim, GAME, 24)[1].max() < 1e-7
    assert starts_of(replace(sim, starts="anywhere"), GAME, 24)[1].max() > 0.01


def test_starts_lie_on_the_target_where_there_is_no_other_room() -> None:
    layout = layout_of("square", scale=2.0**0.5 * 2.0)  # a side of 1
    starts, on = starts_of(SimConfig(starts="outside", arena=1.6), layout, 12)
    assert on.min() > 0.0
    assert np.abs(layout.corners(starts)).max() <= 0.8


@pytest.mark.parametrize("settings", [{}, {"mirrored": 1.0}, {"allow_flip": True}])
def test_starts_in_piles_lie_on_any_side_that_can_be_played(settings: dict[str, Any]) -> None:
    sim, generators = SimConfig(starts="piles", **settings), evaluation_generators(8)
    targets = sample_targets(GAME, sim, sim.task, generators)
    done = np.zeros((8, GAME.tokens), dtype=np.bool_)
    poses, flipped = sample_starts(GAME, sim, targets, done, generators)
    for pose, own in zip(poses, flipped, strict=True):
        assert largest_overlap(GAME, pose, own) < 1e-8
        together = shapely.union_all([piece.buffer(1e-6) for piece in pieces(GAME, pose, own)])
        assert 3 <= len(shapely.get_parts(together)) < GAME.tokens
    if sim.allow_flip:
        assert 0 < flipped.sum() < flipped.size
    else:
        np.testing.assert_array_equal(flipped, targets[1])


@pytest.mark.parametrize(
    ("layout", "settings", "message"),
    [
        (layout_of("square"), {}, "sim.starts=piles changes nothing with one token: leave it out"),
        (
            GAME,
            {"stages": (StageConfig(tokens=2), StageConfig(updates=9))},
            "all 7 tokens in piles, and a stage of sim.stages leaves all but 2 on the target: give",
        ),
    ],
)
def test_piles_that_nobody_plays_are_refused(
    layout: Layout, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        check_targets(layout, SimConfig(starts="piles", **settings))


# Stages: which is played when, and what lies on its target already.

STAGES = (
    StageConfig(updates=10, tokens=1),
    StageConfig(updates=50, tokens=3, targets="gaussian", spread=0.3),
)


@pytest.mark.parametrize(
    ("updates", "stage"), [(0, 0), (9, 0), (10, 1), (49, 1), (50, 2), (1_000_000, 2)]
)
def test_a_stage_begins_with_its_number_of_updates(updates: int, stage: int) -> None:
    assert SimConfig(stages=STAGES).stage(updates) == stage


def test_what_a_stage_plays() -> None:
    sim = SimConfig(stages=STAGES, targets="gaussian", spread=0.4)
    assert sim.task == StageConfig(targets="gaussian", spread=0.4)
    assert [sim.stage_task(stage) for stage in range(3)] == [sim.task, *STAGES]
    assert SimConfig(stages=(StageConfig(),)).stage(0) == 1
    assert SimConfig().stage(99) == 0


def on_target(env: BatchedEnv) -> Bools:
    """(B, K) which tokens lie exactly on their targets."""
    gap = np.abs(env.corners - env.goals).max(axis=2)
    own = [gap[:, env.layout.corners_of(k)].max(axis=1) for k in range(env.layout.tokens)]
    return np.stack(own, axis=1) < 1e-9


@pytest.mark.parametrize("tokens", [1, 3, 6])
@pytest.mark.parametrize("targets", ["uniform", "connected", "figures"])
def test_the_others_lie_on_their_targets_and_are_placed(tokens: int, targets: str) -> None:
    env = begun(StageConfig(tokens=tokens, targets=targets), mirrored=0.5, allow_flip=True)
    assert (env.placed.sum(axis=1) == 7 - tokens).all()
    np.testing.assert_array_equal(on_target(env), env.placed)
    assert len(np.unique(env.placed, axis=0)) > 3  # drawn for each


def test_tokens_to_move_start_clear_of_those_that_lie() -> None:
    """Also where starts may be anywhere: they lie on the table, not on each other."""
    env = begun(StageConfig(tokens=3), count=40)
    for poses, sides in zip(GAME.poses(env.corners), GAME.flipped(env.corners), strict=True):
        assert largest_overlap(GAME, poses, sides) < 1e-8


def test_what_lies_on_its_target_is_refused_and_the_rest_fills_the_episode() -> None:
    env = begun(StageConfig(tokens=1), count=4)
    placed = env.placed.argmax(axis=1)
    before = env.corners.copy()
    actions = np.full((4, 4), 0.3)
    actions[:, 0] = (placed + 0.5) / 3.5 - 1.0
    assert env.step(actions).refused.all()
    np.testing.assert_array_equal(env.corners, before)
    actions[:, 0] = (env.placed.argmin(axis=1) + 0.5) / 3.5 - 1.0
    result = env.step(actions)
    assert not result.refused.any()
    assert env.placed.all()
    assert not result.done


def test_given_targets_are_played() -> None:
    env, other = begun(StageConfig()), begun(StageConfig(targets="figures"), mirrored=0.5)
    poses, sides = GAME.poses(other.goals), GAME.flipped(other.goals)
    env.reset(evaluation_generators(12), (poses, sides))
    np.testing.assert_allclose(env.goals, other.goals, atol=1e-9)
    assert env.steps_done == 0
    with pytest.raises(ValueError, match="need 12 generators, got 3"):
        env.reset(evaluation_generators(3), (poses, sides))
