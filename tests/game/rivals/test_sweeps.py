"""The rule for tokens that slide: by hand, against all orders, and in the engine."""

from contextlib import closing
from itertools import permutations
from typing import Any

import numpy as np
import pytest

from tangram_core.task import Chooser, History
from tangram_sim.batch import BatchedEnv
from tangram_sim.motion.actions import chosen_tokens
from tangram_tasks.place import Place
from tangram_tasks.rivals.baselines import exact_policy
from tangram_tasks.rivals.sweeps import _shares, _swept, best_order, first_slide, sweep_policy
from tests.agent.builders import setup
from tests.sim.builders import SEVEN
from worker.score.test_set import FixedTests

pytestmark = pytest.mark.fast

SLIDE = {"backend": "physics", "motion": "slide"}
GAME = {"shapes": list(SEVEN), "scale": 0.6}
TWO = {"shapes": ["square", "medium_triangle"], "scale": 0.6}
SQUARES = {"shapes": ["square"] * 3, "scale": 0.6}
SIDE = 0.6 * np.sqrt(2.0) / 4.0
# The triangle comes from the left and goes through the square's place.
THROUGH = ((-0.6, 0.7, 0), (-0.7, 0, 0)), ((0, 0, 0), (0.7, 0, 0))
# The triangle lies in the square's place.
OCCUPIED = ((-0.6, 0.0, 0), (0, 0, 0)), ((0, 0, 0), (0.7, 0.3, 0))


def first(made: Place, starts: Any, goals: Any, placed: Any = None) -> tuple[int, np.ndarray]:
    """Which token goes first, and its way."""
    corners, wanted = (made.layout.corners(np.array(p, np.float64)) for p in (starts, goals))
    flags = np.zeros(made.layout.tokens, np.bool_) if placed is None else np.array(placed)
    return first_slide(made.layout, corners, flags, wanted)


@pytest.mark.parametrize(("starts", "goals"), [THROUGH, OCCUPIED])
def test_what_would_be_pushed_waits_and_what_is_in_the_way_goes_first(
    starts: Any, goals: Any
) -> None:
    token, way = first(setup(TWO, **SLIDE).task, starts, goals)
    assert token == 1
    np.testing.assert_allclose(way, np.subtract(goals[1], starts[1]), atol=1e-9)


@pytest.mark.parametrize(
    ("off", "share"), [((0.3, 0.0), 1.0), ((0.3, SIDE / 2), 0.5), ((0.3, 1.01 * SIDE), 0.0)]
)
def test_a_slide_sweeps_the_part_of_a_token_that_is_in_its_way(
    off: tuple[float, float], share: float
) -> None:
    layout = setup(SQUARES, **SLIDE).task.layout
    corners = layout.corners(np.array([(0, 0, 0), (*off, 0), (9.0, 9.0, 0)]))
    swept = _swept(layout, corners, np.array([0]), np.array([(0.6, 0.0, 0.0)]))
    found = _shares(swept, corners[layout.padded_corners])
    np.testing.assert_allclose(found, [[1.0, share, 0.0]], atol=1e-6)


def test_equal_tokens_share_their_pieces_so_that_none_is_in_the_way() -> None:
    """The least way in all would lead through the square that can move no more."""
    starts = ((0, 0, 0), (-0.6, 0, 0), (-0.6, 0.6, 0))
    goals = ((0, 0, 0), (0.6, 0, 0), (0.6, 0.6, 0))
    token, way = first(setup(SQUARES, **SLIDE).task, starts, goals, [True, False, False])
    np.testing.assert_allclose(way, (1.2, {1: 0.6, 2: -0.6}[token], 0.0), atol=1e-9)


def test_who_lies_in_its_place_stays_and_who_can_move_no_more_is_not_named() -> None:
    made = setup(TWO, **SLIDE).task
    _, goals = THROUGH
    for placed, expected in (([True, False], 1), ([False, False], 0)):
        token, way = first(made, goals, goals, placed)
        assert (token, np.abs(way).max()) == (expected, 0.0)
    away = (goals[0], (0.7, 0.02, 0))
    assert first(made, away, goals)[0] == 1
    assert first(made, away, goals, [False, True])[0] == 0


def test_the_best_order_is_that_of_all() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        waiting, done = rng.random((2, 5, 5))
        moves = rng.random(5) < 0.8
        moves[0] = True

        def cost(order: tuple[int, ...], waiting: Any = waiting, done: Any = done) -> float:
            moved, total = np.zeros(5, np.bool_), 0.0
            for token in order:
                total += np.where(moved, done[token], waiting[token]).sum()
                moved[token] = True
            return float(total)

        best = min(permutations(np.flatnonzero(moves).tolist()), key=cost)
        total, token = best_order(moves, waiting, done)
        assert (total, token) == (pytest.approx(cost(best)), best[0])


def covered(made: Place, choose: Chooser, starts: Any, goals: Any) -> tuple[list[int], float]:
    """The tokens that are named in turn, and what is covered in the end, in the engine."""
    layout, named, nothing = made.layout, list[int](), History({}, np.zeros((1, 0, 4)))
    with closing(BatchedEnv(layout, made.sim, made.reward)) as env:
        sides = np.zeros((1, layout.tokens), np.bool_)
        env.reset([np.random.default_rng(0)], (np.array([goals], np.float64), sides))
        env._worlds[0].place(np.array(starts, np.float64))
        env._look()
        for _ in range(env.horizon):
            seen = {"corners": env.seen, "placed": env.closed, "goals": env.seen_goals}
            actions = choose(seen, nothing, []).astype(np.float64)
            named += chosen_tokens(actions, layout.tokens).tolist()
            result = env.step(actions)
        return named, float(result.overlap[0])


def test_in_the_engine_nothing_is_pushed_out_of_its_place() -> None:
    made = setup(TWO, **SLIDE).task
    order, share = covered(made, sweep_policy(made.layout, made.sim), *THROUGH)
    assert order == [1, 0]
    assert share == pytest.approx(1.0, abs=1e-3)
    assert covered(made, exact_policy(made.layout, made.sim), *THROUGH)[1] < 0.9


def test_with_actions_left_what_was_pushed_is_put_back_once() -> None:
    made = setup(TWO, **SLIDE, actions_per_token=2).task
    starts, goals = ((0.05, 0.03, 0.2), (0.7, 0, 0)), ((0, 0, 0), (0.7, 0, 0))
    order, share = covered(made, sweep_policy(made.layout, made.sim), starts, goals)
    assert (order[0], share) == (0, pytest.approx(1.0, abs=1e-3))


def test_seven_tokens_are_laid_better_than_each_alone_and_with_two_actions_nearly_whole() -> None:
    scores = list[float]()
    for count in (1, 2):
        made = setup(GAME, **SLIDE, starts="outside", actions_per_token=count).task
        with closing(FixedTests(made, 8, 8)) as tests:
            for policy in (exact_policy, sweep_policy)[count - 1 :]:
                played = tests.play(policy(made.layout, made.sim))
                scores.append(made.score(played)["coverage"])
    assert scores[0] + 0.1 < scores[1] < scores[2]
    assert scores[2] > 0.95
