"""One move after the other, from wherever the tokens lie."""

from itertools import pairwise

import numpy as np
import pytest
from shapely.geometry import Point, Polygon

from tangram_sim.puzzles.figures import load_puzzle
from tangram_sim.targets.targets import placement, turned_figure
from tangram_studio.playing import PARTS, Move, Sides, begin, next_move, player

pytestmark = pytest.mark.slow


def figure(name: str) -> Sides:
    layout = player().layout
    poses, flipped = placement(load_puzzle(name), layout)
    return Sides(turned_figure(layout, (poses, flipped), 0.0), flipped)


def laid(scene: Sides, goal: Sides, motion: str, most: int = 40) -> list[Move]:
    moves, done = list[Move](), ()
    for _ in range(most):
        move = next_move(scene, goal, motion, done)
        moves.append(move)
        if move.ended:
            assert move.token is None
            return moves
        scene, done = Sides(move.frames[-1], scene.flipped), move.done
    raise AssertionError("no end")


@pytest.mark.parametrize("name", ["cat", "swan", "rabbit"])
def test_every_token_is_carried_to_its_piece_once(name: str) -> None:
    goal = figure(name)
    *moves, end = laid(Sides(begin(goal, 3), goal.flipped), goal, "lift")
    assert sorted(move.token for move in moves if move.token is not None) == list(range(7))
    assert end.iou > 0.99
    assert [len(move.frames) for move in moves] == [2] * 7
    for before, after in pairwise(moves):
        np.testing.assert_allclose(before.frames[-1], after.frames[0], atol=1e-6)


def test_nothing_is_moved_where_all_lie() -> None:
    goal = figure("cat")
    (end,) = laid(goal, goal, "lift")
    assert (end.token, end.frames.shape) == (None, (1, 7, 3))
    assert end.coverage == pytest.approx(1.0, abs=1e-6)


def test_starts_lie_beside_the_figure_and_another_seed_is_another_start() -> None:
    goal = figure("cat")
    first, again, other = (begin(goal, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
    move = next_move(Sides(first, goal.flipped), goal, "lift", ())
    assert move.coverage < 0.3


@pytest.mark.parametrize("name", ["cat", "swan"])  # the swan's parallelogram lies on its other side
def test_a_push_is_shown_in_parts_with_the_finger_beside_its_token(name: str) -> None:
    goal, layout = figure(name), player().layout
    scene, done = Sides(begin(goal, 0), goal.flipped), ()
    for number in range(5):
        move = next_move(scene, goal, "push", done)
        assert move.token is not None
        assert move.finger is not None
        assert (len(move.frames), len(move.finger)) == (PARTS + 1, PARTS + 1)
        assert np.abs(move.frames[-1] - move.frames[0])[move.token].max() > 1e-3
        corners = layout.corners(scene.poses, scene.flipped)[layout.corners_of(move.token)]
        assert Polygon(corners).distance(Point(move.finger[0])) == pytest.approx(0.045, abs=1e-3)
        scene, done = Sides(move.frames[-1], scene.flipped), move.done
        assert len(done) == number + 1


def test_a_push_that_did_nothing_is_not_made_again_in_its_round() -> None:
    goal = figure("cat")
    scene = Sides(begin(goal, 0), goal.flipped)
    first = next_move(scene, goal, "push", ())
    # In between, the process works for another page: a round is known by its arguments alone.
    again, anew = (next_move(scene, goal, "push", done).finger for done in (first.done, ()))
    later = next_move(scene, goal, "push", first.done).finger
    assert later is not None
    np.testing.assert_array_equal(later, again)
    np.testing.assert_array_equal(anew, first.finger)
    assert again is not None
    assert first.finger is not None
    assert not np.allclose(again, first.finger, atol=1e-3)


def test_pushing_ends_after_as_many_pushes_as_an_episode_has() -> None:
    goal = figure("cat")
    scene = Sides(begin(goal, 1), goal.flipped)
    first = next_move(scene, goal, "push", ())
    assert not first.ended
    assert next_move(scene, goal, "push", first.done * 56).ended
    assert next_move(goal, goal, "push", ()).ended  # all lie
