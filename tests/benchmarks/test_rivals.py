"""General optimisation of outlines: one kind of states for all, judged on exact polygons."""

import numpy as np
import pytest
from shapely import Polygon

from tangram_lab.benchmarks.covering import Attempt, Board
from tangram_lab.benchmarks.rivals import RIVALS
from tangram_sim.areas import overlap
from tangram_vision.silhouettes import Filled, covered
from tests.sim.builders import layout_of

pytestmark = pytest.mark.fast

PAIR = layout_of("small_triangle", "parallelogram", scale=1.0)
# The triangle stands with its right angle on the parallelogram's slanting side.
DRAWN = np.array([0j, 0.5, 0.75 + 0.25j, 0.25 + 0.25j, 0.5j])
OWN = ("simulated annealing", "genetic algorithm")


def figure(mirrored: bool) -> Polygon:
    z = (DRAWN.conj() if mirrored else DRAWN) * np.exp(0.3j) + 2.0 - 1.0j
    return Polygon(np.column_stack([z.real, z.imag]))


def attempted(name: str, area: Polygon, evaluations: int, seed: int = 0) -> Filled:
    """By evaluations alone, since a clock would let the machine decide."""
    attempt = Attempt(Board(area, PAIR), np.inf, evaluations)
    return RIVALS[name](attempt, np.random.default_rng(seed))


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("name", OWN)
def test_two_tokens_are_found_at_any_angle_and_on_either_side(name: str, mirrored: bool) -> None:
    filled = attempted(name, figure(mirrored), 100_000)
    assert filled.found is not None
    assert filled.iou > 0.95
    assert filled.iou == pytest.approx(overlap(covered(PAIR, filled.found), figure(mirrored)))
    assert filled.found.flipped.tolist() == [False, mirrored]
    assert 0 < filled.nodes < 100_000


@pytest.mark.parametrize("name", RIVALS)
def test_a_seed_decides_and_evaluations_are_bounded(name: str) -> None:
    """A figure that nothing fills: the attempt goes on to its end."""
    disc = Polygon([(np.cos(a) * 0.244, np.sin(a) * 0.244) for a in np.arange(0.0, 6.28, 0.1)])
    first, again, other = (attempted(name, disc, 1_000, seed) for seed in (1, 1, 2))
    assert first.found is not None
    assert again.found is not None
    assert other.found is not None
    assert np.array_equal(first.found.poses, again.found.poses)
    assert not np.array_equal(first.found.poses, other.found.poses)
    assert 0.5 < first.iou < 0.95
    assert 1_000 <= first.nodes <= 1_000 + 16 * 256  # annealing looks at every 16th step


@pytest.mark.parametrize("name", RIVALS)
def test_an_attempt_ends_when_its_time_is_over(name: str) -> None:
    disc = Polygon([(np.cos(a) * 0.244, np.sin(a) * 0.244) for a in np.arange(0.0, 6.28, 0.1)])
    filled = RIVALS[name](Attempt(Board(disc, PAIR), 0.0, 20_000), np.random.default_rng(0))
    assert 0 < filled.nodes <= 1_024


def test_what_is_uncovered_is_counted_on_points_of_the_outline() -> None:
    """The triangle alone covers a third."""
    board = Board(figure(False), PAIR)
    way = np.exp(0.3j)
    centres = (np.array([(0.25 + 0.75j) / 3.0, 0.375 + 0.125j]) * way + 2.0 - 1.0j)[None]
    laid = [
        (float(board.states(centres, np.array([[first, second]])).uncovered()[0]), first, second)
        for first in range(8)
        for second in range(board.lies)
    ]
    assert min(laid)[0] == 0.0
    _, first, second = min(laid)
    away = np.array([[centres[0, 0], 9.0]])
    alone = board.states(away, np.array([[first, second]])).uncovered()
    assert alone == pytest.approx(2.0 / 3.0, abs=0.01)
