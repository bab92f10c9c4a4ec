"""Scores of several tokens: hand-made ends with known scores, and shapely for the areas."""

from typing import Any

import numpy as np
import pytest
import shapely

from tangram_sim.arrays import Bools, Floats
from tangram_sim.config import SimConfig
from tangram_sim.layout import Layout
from tangram_sim.puzzles import library
from tangram_sim.sampling import sample_batch
from tests.sim.builders import SEVEN, layout_of, random_poses
from worker.metrics import Assembled, assembled, covered_shares, pose_errors, summarise
from worker.rollout import Played

pytestmark = pytest.mark.fast

CAT = next(puzzle for puzzle in library("train") if puzzle.name == "cat")
LAYOUT = CAT.layout


def ended(layout: Layout, ends: Floats, goals: Floats, **more: Bools) -> Played:
    """Episodes that end with corners (E, V, 2), whatever was played before."""
    episodes, tokens = len(ends), layout.tokens
    nothing = np.zeros((episodes, tokens), dtype=np.bool_)
    columns: dict[str, Any] = {
        "corners": np.stack([goals, ends], axis=1),
        "placed": np.zeros((episodes, 2, tokens), dtype=np.bool_),
        "actions": np.zeros((episodes, tokens, 4), np.float32),
        "rewards": np.zeros((episodes, tokens)),
        "goals": goals,
        "seen": np.stack([goals, ends], axis=1),
        "seen_goals": goals,
        "overlap": np.zeros(episodes),
        "refused": nothing,
        "blocked": nothing,
        "seconds": np.ones(episodes),
        "camera": None,
    }
    return Played(**(columns | more))


def scored(poses: Floats, flipped: Bools | None = None) -> Assembled:
    """Scores of the cat's pieces at poses (7, 3)."""
    ends = LAYOUT.corners(poses, flipped)[None]
    return assembled(LAYOUT, ended(LAYOUT, ends, CAT.corners[None]))


def swapped(*pair: int) -> Floats:
    """The cat with two pieces in each other's place."""
    poses = CAT.poses.copy()
    poses[list(pair)] = poses[list(reversed(pair))]
    return poses


def union(layout: Layout, corners: Floats) -> shapely.Geometry:
    pieces = [shapely.Polygon(corners[layout.corners_of(k)]) for k in range(layout.tokens)]
    return shapely.union_all(pieces, grid_size=1e-9)


@pytest.mark.parametrize("chance_of_other_side", [0.0, 0.5])
def test_areas_equal_those_of_shapely(chance_of_other_side: float) -> None:
    layout = layout_of(*SEVEN, scale=0.8)
    rng = np.random.default_rng(0)
    sides = (rng.random((20, 7)) < chance_of_other_side) & layout.chiral
    ends = layout.corners(random_poses(rng, 20, 7, 0.5), sides)
    goals = layout.corners(sample_batch(layout, SimConfig(), [rng] * 20))
    found = assembled(layout, ended(layout, ends, goals))
    for e in range(20):
        tokens, target = union(layout, ends[e]), union(layout, goals[e])
        common = shapely.intersection(tokens, target, grid_size=1e-9).area
        assert found.coverage[e] == pytest.approx(common / target.area, abs=1e-6)
        assert found.iou[e] == pytest.approx(
            common / shapely.union(tokens, target, grid_size=1e-9).area, abs=1e-6
        )
    assert found.iou.min() < 0.6 * found.iou.max()


def test_a_figure_that_is_made_up_exactly() -> None:
    for poses in (CAT.poses, swapped(0, 1), swapped(3, 4)):
        found = scored(poses)
        np.testing.assert_allclose([found.coverage, found.iou], 1.0, atol=1e-9)
        assert found.solved.tolist() == [True]
        assert (found.wrong[0], found.doubly_used[0]) == (0, 0)


def test_tokens_in_one_heap_do_not_fill_the_figure_by_their_number() -> None:
    poses = np.zeros((7, 3))
    poses[:, :2] = CAT.poses[0, :2]
    found = scored(poses)
    assert found.coverage[0] < 0.5
    assert found.iou[0] < found.coverage[0]
    assert not found.solved[0]


# target piece that is uncovered or covered by what, -> wrong, doubly used
NAMES = {name: SEVEN.index(name) for name in SEVEN}


@pytest.mark.parametrize(
    ("piece", "by", "wrong"),
    [
        ("square", (), 0),  # nothing lies there: missing, not wrong
        ("square", ("medium_triangle",), 1),
        ("large_triangle", ("square",), 1),
        ("large_triangle", ("small_triangle",), 1),
        ("medium_triangle", ("large_triangle",), 1),
    ],
)
def test_a_piece_under_another_shape_is_wrong(piece: str, by: tuple[str, ...], wrong: int) -> None:
    goal = np.zeros((7, 3))
    goal[:, 0] = 4.0 * np.arange(7)  # every piece by itself
    ends = goal + [0.0, 50.0, 0.0]
    for name in by:
        ends[NAMES[name]] = goal[NAMES[piece]]
    layout = layout_of(*SEVEN)
    found = assembled(layout, ended(layout, layout.corners(ends)[None], layout.corners(goal)[None]))
    assert (found.wrong[0], found.doubly_used[0]) == (wrong, 0)


@pytest.mark.parametrize(
    ("shifts", "doubly"),
    [
        ((0.0, 0.0), 1),
        ((0.2, 0.0), 1),
        ((0.2, 0.3), 0),  # of a square of side 0.4: 0.5 and 0.25
        ((0.2, 0.29), 1),
        ((0.3, 0.35), 0),
    ],
)
def test_a_piece_is_doubly_used_beyond_a_quarter_each(
    shifts: tuple[float, float], doubly: int
) -> None:
    layout = layout_of("square", "square")
    goals = layout.corners(np.array([[[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]]))
    ends = layout.corners(np.array([[[shift, 0.0, 0.0] for shift in shifts]]))
    assert assembled(layout, ended(layout, ends, goals)).doubly_used.tolist() == [doubly]


def test_a_neighbour_that_reaches_over_makes_no_piece_wrong() -> None:
    layout = layout_of("square", "small_triangle")
    goals = layout.corners(np.array([[[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]] * 2))
    square = layout.shapes[0].corners[:, 0].max()
    left = -layout.shapes[1].corners[:, 0].min()
    ends = goals.copy()
    for e, depth in enumerate((0.02, 0.3)):
        x = square + left - depth
        ends[e] = layout.corners(np.array([[9.0, 0.0, 0.0], [x, 0.0, 0.0]]))
    covered = covered_shares(layout, ends, goals)[:, 0, 1]
    assert 0.0 < covered[0] < 0.05 < covered[1]
    assert assembled(layout, ended(layout, ends, goals)).wrong.tolist() == [0, 1]


def test_a_parallelogram_on_its_other_side_is_another_shape() -> None:
    flipped = np.array([name == "parallelogram" for name in SEVEN])
    found = scored(CAT.poses, flipped)
    assert found.wrong[0] == 1
    ends = LAYOUT.corners(CAT.poses, flipped)[None]
    assert pose_errors(LAYOUT, ends, CAT.corners[None])[1][0].round(9).tolist() == [0] * 6 + [90]


def test_refused_and_blocked_actions_are_counted() -> None:
    refused, blocked = np.zeros((2, 2, 7), dtype=np.bool_)
    refused[0, [1, 2]] = blocked[1, 5] = True
    ends = np.repeat(CAT.corners[None], 2, axis=0)
    found = assembled(LAYOUT, ended(LAYOUT, ends, ends, refused=refused, blocked=blocked))
    assert found.refused.tolist() == [2, 0]
    assert found.blocked.tolist() == [0, 1]
    assert found.actions_used.tolist() == [5, 7]
    assert found.means() == pytest.approx(
        {"coverage": 1.0, "iou": 1.0, "share_solved": 1.0, "wrong": 0.0, "doubly_used": 0.0}
        | {"refused": 1.0, "blocked": 0.5, "actions_used": 6.0}
    )


def test_equal_pieces_may_change_places_in_every_score() -> None:
    played = ended(LAYOUT, LAYOUT.corners(swapped(0, 1))[None], CAT.corners[None])
    scores = summarise(LAYOUT, SimConfig(), played, own_reward=False)
    assert scores["position_error_p90"] == pytest.approx(0.0, abs=1e-9)
    assert scores["angle_error_deg_p90"] == pytest.approx(0.0, abs=1e-6)
    assert scores["coverage"] == pytest.approx(1.0)


def test_covered_at_95_per_cent_is_solved() -> None:
    layout = layout_of("square", "square")
    goals = layout.corners(np.array([[[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]] * 2))
    ends = goals.copy()
    for e, missing in enumerate((0.1 - 1e-6, 0.1 + 1e-6)):  # of one of two squares of side 0.4
        ends[e, :4, 0] += 0.4 * missing
    assert assembled(layout, ended(layout, ends, goals)).solved.tolist() == [True, False]
