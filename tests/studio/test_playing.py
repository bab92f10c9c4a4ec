"""One move after the other, from wherever the tokens lie."""

from itertools import pairwise

import numpy as np
import pytest

from tangram_sim.puzzles.figures import load_puzzle
from tangram_sim.targets.targets import placement, turned_figure
from tangram_studio.playing import PARTS, Move, Round, Sides, begin, next_move, player

pytestmark = pytest.mark.slow


def figure(name: str) -> Sides:
    layout = player("lift").layout
    poses, flipped = placement(load_puzzle(name), layout)
    return Sides(turned_figure(layout, (poses, flipped), 0.0), flipped)


def laid(scene: Sides, goal: Sides, motion: str, most: int = 40) -> list[Move]:
    moves, done = list[Move](), None
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
    *moves, end = laid(Sides(begin(goal, "lift", 3), goal.flipped), goal, "lift")
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
    first, again, other = (begin(goal, "lift", seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
    move = next_move(Sides(first, goal.flipped), goal, "lift", None)
    assert move.coverage < 0.3


def test_a_push_is_shown_in_parts_and_moves_what_is_in_its_way() -> None:
    goal = figure("cat")
    scene, done, parts = Sides(begin(goal, "slide", 0), goal.flipped), None, set[int]()
    others = 0
    for _ in range(12):
        move = next_move(scene, goal, "slide", done)
        assert isinstance(move.done, Round)
        assert move.token is not None
        parts.add(len(move.frames))
        moved = np.abs(move.frames[-1] - move.frames[0]).max(axis=1) > 1e-3
        assert moved[move.token]
        others += moved.sum() - 1
        scene, done = Sides(move.frames[-1], scene.flipped), move.done
    assert parts == {PARTS + 1}
    assert others > 0
    assert len(move.done.actions) == 12


def test_a_pushed_token_has_as_many_actions_as_the_agent_has() -> None:
    goal = figure("swan")
    moves = laid(Sides(begin(goal, "slide", 1), goal.flipped), goal, "slide")
    tokens = [move.token for move in moves if move.token is not None]
    allowed = player("slide").run.task.sim.actions_per_token
    assert max(np.bincount(tokens)) <= allowed
