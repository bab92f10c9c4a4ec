"""Tokens that look alike keep their names, what is missing stays, and a hand finds what is seen."""

from collections.abc import Iterable

import numpy as np
import pytest

from tangram_core.arrays import Floats, Pixels
from tangram_sim.sight.perception import Look, Sight
from tests.sim.builders import layout_of

pytestmark = pytest.mark.fast

LAYOUT = layout_of("square", "small_triangle", "small_triangle")
PICTURES: Pixels = np.zeros((1, 16, 16), np.uint8)
START = [(0.5, 0.5, 0.0), (-0.5, 0.0, 0.3), (0.5, -0.5, 0.6)]
GOAL = [(0.0, 0.0, 0.0), (-0.5, 0.5, 0.3), (0.1, -0.5, 0.6)]


def look(poses: Iterable[tuple[float, float, float] | None], doubtful: int | None = None) -> Look:
    every = list(poses)
    known = np.array([pose is not None for pose in every])
    there = np.array([pose or (0.0, 0.0, 0.0) for pose in every])
    return Look(there, np.zeros(3, np.bool_), known, known & (np.arange(3) != doubtful))


def sight(*looks: Look) -> Sight:
    shown = iter(looks)
    return Sight(LAYOUT, lambda *_: next(shown), 1, 2.0)


def places(corners: Floats) -> list[list[float]]:
    return np.round(LAYOUT.bases(corners), 6).tolist()


def test_a_token_that_moved_keeps_its_name_whatever_the_order_of_what_is_found() -> None:
    moved = [START[0], (0.45, -0.45, 0.0), START[2]]  # the second token, beside the third
    seen = sight(look(START), look(GOAL), look([moved[0], moved[2], moved[1]]))
    seen.begin(PICTURES, PICTURES)
    seen.follow(PICTURES, np.array([1]), np.zeros((1, 3)))
    assert places(seen.corners[0]) == [[x, y] for x, y, _ in moved]
    assert not seen.missing.any()


def test_what_is_missing_lies_where_it_lay_and_is_found_again() -> None:
    seen = sight(look(START), look(GOAL), look([None, *START[1:]]), look(START))
    seen.begin(PICTURES, PICTURES)
    before = seen.corners
    seen.follow(PICTURES, np.array([0]), np.zeros((1, 3)))
    assert places(seen.corners[0]) == places(before[0])
    assert seen.missing.tolist() == [[True, False, False]]
    assert seen.corners is not before
    seen.follow(PICTURES, np.array([0]), np.zeros((1, 3)))
    assert not seen.missing.any()


def test_what_left_the_picture_lies_where_it_was_told_to_go() -> None:
    seen = sight(look(START), look(GOAL), look([None, *START[1:]]))
    seen.begin(PICTURES, PICTURES)
    seen.follow(PICTURES, np.array([0]), np.array([[0.8, 0.0, 0.1]]))
    assert places(seen.corners)[0][0] == [1.3, 0.5]
    assert seen.away.tolist() == seen.missing.tolist() == [[True, False, False]]


def test_what_is_doubtful_has_a_place_and_counts_as_missing() -> None:
    seen = sight(look(START, doubtful=0), look(GOAL))
    seen.begin(PICTURES, PICTURES)
    assert places(seen.corners[0])[0] == [0.5, 0.5]
    assert seen.missing.tolist() == [[True, False, False]]


def test_a_piece_of_the_target_that_is_missing_lies_where_its_token_begins() -> None:
    seen = sight(look(START), look([*GOAL[:2], None]))
    seen.begin(PICTURES, PICTURES)
    assert places(seen.goals[0]) == [*[[x, y] for x, y, _ in GOAL[:2]], [0.5, -0.5]]
    assert seen.goals_sure.tolist() == [[True, True, False]]


def test_a_piece_of_the_target_that_could_lie_otherwise_is_covered_where_it_was_seen() -> None:
    seen = sight(look(START), look(GOAL, doubtful=0))
    seen.begin(PICTURES, PICTURES)
    assert places(seen.goals[0]) == [[x, y] for x, y, _ in GOAL]
    assert seen.goals_sure.tolist() == [[False, True, True]]


def test_a_hand_takes_the_token_that_lies_where_one_is_seen() -> None:
    seen = sight(look(START), look(GOAL))
    seen.begin(PICTURES, PICTURES)
    true = LAYOUT.corners(np.array([[START[0], START[2], START[1]]]))
    hands = [int(seen.hands(np.array([token]), true)[0]) for token in range(3)]
    assert hands == [0, 2, 1]


@pytest.mark.parametrize("told", [0.1, 1.4, -3.0, 2.9])
def test_a_square_turned_about_as_it_was_told(told: float) -> None:
    """Its picture is the same after a quarter of a turn; the motion's model learns from turns."""
    turned = (0.5, 0.5, (told + 0.05) % (np.pi / 2.0))
    seen = sight(look(START), look(GOAL), look([turned, *START[1:]]))
    seen.begin(PICTURES, PICTURES)
    before = LAYOUT.poses(seen.corners)[0, 0, 2]
    seen.follow(PICTURES, np.array([0]), np.array([[0.0, 0.0, told]]))
    turn = LAYOUT.poses(seen.corners)[0, 0, 2] - before
    assert np.angle(np.exp(1j * (turn - told))) == pytest.approx(0.05)
