"""Scores of hand-made ends whose values are known exactly, and shapely for the areas."""

import math

import numpy as np
import pytest
import shapely

from tangram_core.arrays import Bools, Floats
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.puzzles.figures import library
from tangram_sim.targets.sampling import sample_batch
from tangram_tasks.metrics import Assembled, assembled, covered_shares, pose_errors, summarise
from tangram_tasks.played import Played
from tests.sim.builders import SEVEN, layout_of, random_poses
from tests.worker.builders import ended

pytestmark = pytest.mark.fast

CAT = next(puzzle for puzzle in library("train") if puzzle.name == "cat")
LAYOUT = CAT.layout


def over(layout: Layout, ends: Floats, goals: Floats) -> Assembled:
    """Scores of episodes that end with corners (E, V, 2), whatever was played before."""
    return assembled(layout, ended(layout, np.stack([goals, ends], axis=1), goals))


def scored(poses: Floats, flipped: Bools | None = None) -> Assembled:
    """Scores of the cat's pieces at poses (7, 3)."""
    ends = LAYOUT.corners(poses, flipped)[None]
    return over(LAYOUT, ends, CAT.corners[None])


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
    found = over(layout, ends, goals)
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
    found = over(layout, layout.corners(ends)[None], layout.corners(goal)[None])
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
    assert over(layout, ends, goals).doubly_used.tolist() == [doubly]


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
    assert over(layout, ends, goals).wrong.tolist() == [0, 1]


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
    corners = np.repeat(ends[:, None], 8, axis=1)
    found = assembled(LAYOUT, ended(LAYOUT, corners, ends, refused=refused, blocked=blocked))
    assert found.refused.tolist() == [2, 0]
    assert found.blocked.tolist() == [0, 1]
    assert found.actions_used.tolist() == [5, 7]
    assert found.means() == pytest.approx(
        {"coverage": 1.0, "iou": 1.0, "solved": 1.0, "wrong": 0.0, "doubly_used": 0.0}
        | {"refused": 1.0, "blocked": 0.5, "actions_used": 6.0}
    )


def test_equal_pieces_may_change_places_in_every_score() -> None:
    goals = CAT.corners[None]
    ends = LAYOUT.corners(swapped(0, 1))[None]
    played = ended(LAYOUT, np.stack([goals, ends], axis=1), goals)
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
    assert over(layout, ends, goals).solved.tolist() == [True, False]
    # An outline is solved by its IoU, which is .905 here.
    played = ended(layout, np.stack([goals, ends], axis=1), goals)
    assert assembled(layout, played, outlines=True).solved.tolist() == [False, False]


# Errors of pose, and the scores of a set


def at(layout: Layout, *poses: tuple[float, float, float]) -> np.ndarray:
    """Corners (E, V, 2) of E poses of one token, angles in degrees."""
    array = np.array(poses, dtype=float)
    array[:, 2] = np.radians(array[:, 2])
    return layout.corners(array[:, None])


# shape, angle of the end, angle of the goal, error: all in degrees
TURNS = [
    ("square", 30, 0, 30),
    ("square", 45, 0, 45),
    ("square", 90, 0, 0),
    ("square", 185, 0, 5),
    ("square", -170, 179, 11),
    ("parallelogram", 90, 0, 90),
    ("parallelogram", 180, 0, 0),
    ("parallelogram", -100, 100, 20),
    ("large_triangle", 180, 0, 180),
    ("large_triangle", 90, 0, 90),
    ("large_triangle", 179, -179, 2),
    ("large_triangle", 350, 0, 10),
]


@pytest.mark.parametrize(("shape", "end", "goal", "error"), TURNS)
def test_angle_error_is_taken_modulo_the_symmetry(
    shape: str, end: float, goal: float, error: float
) -> None:
    layout = layout_of(shape)
    position, angle = pose_errors(layout, at(layout, (0.1, 0.2, end)), at(layout, (0.1, 0.2, goal)))
    np.testing.assert_allclose(angle, [[error]], atol=1e-9)
    np.testing.assert_allclose(position, [[0.0]], atol=1e-12)


@pytest.mark.parametrize("shape", ["square", "parallelogram", "small_triangle"])
def test_position_error_is_the_distance_of_the_centres(shape: str) -> None:
    layout = layout_of(shape)
    ends, goals = at(layout, (0.3, -0.4, 77)), at(layout, (0.0, 0.0, -20))
    np.testing.assert_allclose(pose_errors(layout, ends, goals)[0], [[0.5]])


def test_each_token_is_measured_against_its_own_target() -> None:
    layout = layout_of("square", "large_triangle")
    ends = layout.corners(np.array([[[0.0, 0.0, 0.1], [1.0, 0.0, 0.2]]]))
    goals = layout.corners(np.array([[[0.0, 0.2, 0.0], [1.0, 0.0, 0.0]]]))
    position, angle = pose_errors(layout, ends, goals)
    np.testing.assert_allclose(position, [[0.2, 0.0]], atol=1e-12)
    np.testing.assert_allclose(angle, np.degrees([[0.1, 0.2]]))


def eleven(camera: Floats | None) -> tuple[Layout, Played]:
    """Eleven squares that end 0, 0.01 ... 0.1 off and 0, 1 ... 10 degrees turned."""
    layout, steps = layout_of("square"), np.arange(11.0)
    goals = at(layout, *[(0.0, 0.0, 0.0)] * 11)
    ends = at(layout, *[(0.01 * i, 0.0, i) for i in steps])
    rewards = (steps[:, None] / 100.0).astype(np.float32)
    path = np.stack([goals + 1.0, ends], axis=1)
    more = {"rewards": rewards, "coverage": steps / 10.0, "camera": camera}
    return layout, ended(layout, path, goals, **more)


def test_the_scores_of_a_known_set() -> None:
    layout, made = eleven(np.full(11, 0.25))
    scores = summarise(layout, SimConfig(), made, own_reward=True)
    # Eq. 15: 1 - 2 log(1 + d / 0.01) / log(1 + D / 0.01), D the diagonal of the arena
    whole = math.log1p(math.sqrt(8.0) / 0.01)
    dense = np.mean(1.0 - 2.0 * np.log1p(np.arange(11)) / whole)
    assert scores == pytest.approx(
        {
            "mean_reward": 0.0,
            "mean_reward_dense": dense,
            "coverage": 0.5,
            "coverage_p10": 0.1,
            "angle_error_deg_median": 5.0,
            "angle_error_deg_p90": 9.0,
            "position_error_median": 0.05,
            "position_error_p90": 0.09,
            "mean_reward_camera": 0.25,
            "mean_train_reward": 0.05,
        }
    )


def test_scores_that_do_not_exist_are_left_out() -> None:
    layout, made = eleven(None)
    scores = summarise(layout, SimConfig(), made, own_reward=False)
    assert "mean_reward_camera" not in scores
    assert "mean_train_reward" not in scores
