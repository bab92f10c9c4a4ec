"""Scores of hand-made episodes whose errors are known exactly."""

import math

import numpy as np
import pytest

from tangram_sim.config import SimConfig
from tangram_sim.layout import Layout, TokensConfig, make_layout
from worker.metrics import pose_errors, summarise
from worker.rollout import Played

pytestmark = pytest.mark.fast


def layout_of(*shapes: str) -> Layout:
    return make_layout(TokensConfig(shapes, 1.0))


def corners(layout: Layout, *poses: tuple[float, float, float]) -> np.ndarray:
    """Corners (E, V, 2) of E poses of one token, angles in degrees."""
    array = np.array(poses, dtype=float)
    array[:, 2] = np.radians(array[:, 2])
    return layout.corners(array[:, None])


# shape, angle of the end, angle of the goal, error: all in degrees
TURNS = [
    ("square", 0, 0, 0),
    ("square", 30, 0, 30),
    ("square", 45, 0, 45),
    ("square", 60, 0, 30),
    ("square", 90, 0, 0),
    ("square", 185, 0, 5),
    ("square", -170, 179, 11),
    ("parallelogram", 90, 0, 90),
    ("parallelogram", 170, 0, 10),
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
    position, angle = pose_errors(
        layout, corners(layout, (0.1, 0.2, end)), corners(layout, (0.1, 0.2, goal))
    )
    np.testing.assert_allclose(angle, [[error]], atol=1e-9)
    np.testing.assert_allclose(position, [[0.0]], atol=1e-12)


@pytest.mark.parametrize("shape", ["square", "parallelogram", "small_triangle"])
def test_position_error_is_the_distance_of_the_centres(shape: str) -> None:
    layout = layout_of(shape)
    ends, goals = corners(layout, (0.3, -0.4, 77)), corners(layout, (0.0, 0.0, -20))
    np.testing.assert_allclose(pose_errors(layout, ends, goals)[0], [[0.5]])


def test_each_token_is_measured_against_its_own_target() -> None:
    layout = layout_of("square", "large_triangle")
    ends = layout.corners(np.array([[[0.0, 0.0, 0.1], [1.0, 0.0, 0.2]]]))
    goals = layout.corners(np.array([[[0.0, 0.2, 0.0], [1.0, 0.0, 0.0]]]))
    position, angle = pose_errors(layout, ends, goals)
    np.testing.assert_allclose(position, [[0.2, 0.0]], atol=1e-12)
    np.testing.assert_allclose(angle, np.degrees([[0.1, 0.2]]))


def played(layout: Layout, camera: np.ndarray | None) -> Played:
    """Eleven squares that end 0, 0.01 ... 0.1 off and 0, 1 ... 10 degrees turned."""
    steps = np.arange(11.0)
    goals = corners(layout, *[(0.0, 0.0, 0.0)] * 11)
    ends = corners(layout, *[(0.01 * i, 0.0, i) for i in steps])
    return Played(
        corners=np.stack([goals + 1.0, ends], axis=1),
        placed=np.array([[[False], [True]]] * 11),
        actions=np.zeros((11, 1, 3), np.float32),
        rewards=steps[:, None] / 100.0,
        goals=goals,
        seen=np.stack([goals + 1.0, ends], axis=1),
        seen_goals=goals,
        overlap=steps / 10.0,
        refused=np.zeros((11, 1), dtype=np.bool_),
        blocked=np.zeros((11, 1), dtype=np.bool_),
        seconds=np.zeros(11),
        camera=camera,
    )


def test_the_scores_of_a_known_set() -> None:
    layout = layout_of("square")
    made = played(layout, np.full(11, 0.25))
    scores = summarise(layout, SimConfig(), made, own_reward=True)
    # Eq. 15: 1 - 2 log(1 + 100 d / reach) / log(101), reach the diagonal of the arena
    distances = np.arange(11) * 0.01 / math.sqrt(8.0)
    dense = np.mean(1.0 - 2.0 * np.log1p(100.0 * distances) / math.log(101.0))
    assert scores == pytest.approx(
        {
            "mean_reward": 0.0,
            "mean_reward_dense": dense,
            "raw_overlap": 0.5,
            "raw_overlap_p10": 0.1,
            "angle_error_deg_median": 5.0,
            "angle_error_deg_p90": 9.0,
            "position_error_median": 0.05,
            "position_error_p90": 0.09,
            "episodes": 11.0,
            "mean_reward_camera": 0.25,
            "mean_train_reward": 0.05,
        }
    )


def test_scores_that_do_not_exist_are_left_out() -> None:
    layout = layout_of("square")
    scores = summarise(layout, SimConfig(), played(layout, None), own_reward=False)
    assert "mean_reward_camera" not in scores
    assert "mean_train_reward" not in scores
