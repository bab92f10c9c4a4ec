"""Tokens that a finger pushes: what a push is, where they come, and who learned nothing."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import tangram_sim.world.pushing as table_module
import tangram_tasks.push.alone as alone_module
import tangram_tasks.push.rivals as rival_module
from tangram_core.conformance import check_task, play
from tangram_core.errors import ConfigError, SamplingError
from tangram_core.seeding import episode_generator
from tangram_sim.geometry.layout import TokensConfig
from tangram_sim.world.pushing import PushTable, Unknowns
from tangram_tasks.goal_env import push as push_env
from tangram_tasks.push.order import come_next
from tangram_tasks.push.places import AWAY, corners_of, errors, on_table, push_of
from tangram_tasks.push.task import Push, PushConfig
from tangram_tasks.push.trials import middle
from tangram_tasks.register import SEVEN

pytestmark = pytest.mark.fast

SCALE = 0.8 * 2**0.5  # the square's side is 0.4
SQUARE = Push(TokensConfig(("square",), SCALE))
TWO = Push(TokensConfig(("square", "small_triangle"), SCALE))
SOME = Push(TokensConfig(("square", "small_triangle", "parallelogram"), 0.6), PushConfig(count=2))
LONGEST, FINGER = PushConfig.longest, PushConfig.finger


def generators(count: int) -> list[np.random.Generator]:
    return [episode_generator(1, "test", 0, 0, i) for i in range(count)]


@pytest.fixture
def few_tried(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name, less in (("PUSHES", 300), ("GRID", (13, 13, 9)), ("SWEEPS", 6)):
        monkeypatch.setattr(alone_module, name, less)
    alone_module.tried_alone.cache_clear()
    yield
    alone_module.tried_alone.cache_clear()


@pytest.mark.parametrize("task", [SQUARE, SOME], ids=["square", "two of three"])
def test_it_keeps_the_promises_of_a_task(
    task: Push, few_tried: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rival_module, "TRIED", 2)
    check_task(task)


def test_in_place_is_within_the_tolerances_and_up_to_symmetry() -> None:
    layout = SQUARE.layout
    goal = layout.corners(np.zeros((1, 1, 3)))
    for pose, expected in (
        ((0.029, 0, 0), True),
        ((0.031, 0, 0), False),
        ((0.02, 0.02, 0.09 + np.pi / 2), True),
        ((0, 0, 0.11), False),
        ((0, 0, np.pi / 4), False),
    ):
        corners = layout.corners(np.array([[pose]], np.float64)).astype(np.float32)
        assert SQUARE.placed(corners, goal).tolist() == [[expected]]
        assert SQUARE.rewards(corners, goal).tolist() == [float(expected) - 1.0]
        assert SQUARE.ended(corners, goal, np.zeros(1, bool)).tolist() == [expected]


def test_a_token_that_is_away_does_not_count() -> None:
    layout = TWO.layout
    goal = layout.corners(np.zeros((2, 2, 3)))
    goal[:, layout.corners_of(1)] = AWAY
    corners = goal.copy()
    corners[1, layout.corners_of(0)] += 0.5
    assert TWO.rewards(corners, goal).tolist() == [0.0, -1.0]
    goal[:, layout.corners_of(1)], corners[:, layout.corners_of(1)] = 0.0, 0.0
    assert TWO.rewards(corners, goal).tolist() == [0.0, -0.5]


def scene(*poses: tuple[float, float, float]) -> np.ndarray:
    corners: np.ndarray = TWO.layout.corners(np.array(poses, np.float64))
    return corners


# Shares of the square's perimeter, and a short push from the middle of its first side.
SIDES = -0.75, -0.25, 0.25, 0.75  # the middle of each
UP = (-1, SIDES[0], 0, 0)


def test_a_push_goes_inwards_from_where_it_begins() -> None:
    push = push_of(TWO.layout, scene((0, 0, 0), (0.6, 0.6, 0)), UP, FINGER, LONGEST)
    assert push.refused == ""
    side = np.abs(TWO.layout.corners(np.zeros((2, 3)))[:4]).max()
    assert np.abs(push.begin).max() == pytest.approx(side + FINGER + 0.005)
    assert np.dot(push.begin, push.way) == pytest.approx(
        -np.linalg.norm(push.begin) * np.linalg.norm(push.way)
    )
    far = push_of(TWO.layout, scene((0, 0, 0), (0.6, 0.6, 0)), (-1, -0.75, 0, 1), FINGER, LONGEST)
    assert np.linalg.norm(far.way) == pytest.approx(LONGEST + 0.005)


@pytest.mark.parametrize(
    ("poses", "why"),
    [
        (((0.8, 0, 0), (-0.6, 0.6, 0)), "the table ends there"),
        (((0, 0, 0), (0.3, 0, 0)), "token 1 is in the way"),
    ],
)
def test_where_the_finger_cannot_come_down_nothing_moves(poses: Any, why: str) -> None:
    turns = [push_of(TWO.layout, scene(*poses), (-1, s, 0, 0), FINGER, LONGEST) for s in SIDES]
    assert [one.refused for one in turns].count(why) == 1
    with closing(TWO.make(1)) as env:
        env.reset(generators(1))
        env.corners[0] = scene(*poses)
        number = [one.refused for one in turns].index(why)
        before = env.corners.copy()
        env.step(np.array([[-1, SIDES[number], 0, 0]], np.float32))
        np.testing.assert_array_equal(env.corners, before)
        assert env.refused == [why]
        assert env.facts()["refused"].tolist() == [True]


def test_a_token_that_is_not_there_is_not_pushed() -> None:
    corners = scene((0, 0, 0), (0.6, 0.6, 0))
    corners[TWO.layout.corners_of(1)] = AWAY
    push = push_of(TWO.layout, corners, (1, 0, 0, 0), FINGER, LONGEST)
    assert push.refused == "token 1 is not on the table"


def test_the_finger_stops_where_the_table_ends() -> None:
    corners, aimed = scene((0.75, 0, 0), (-0.6, 0, 0)), ((s, t) for s in SIDES for t in (-1, 0, 1))
    made = [push_of(TWO.layout, corners, (-1, s, t, 1), FINGER, LONGEST) for s, t in aimed]
    went = [one for one in made if not one.refused]
    assert all((np.abs(one.begin + one.way) <= 1 - FINGER + 1e-12).all() for one in went)
    assert min(np.linalg.norm(one.way) for one in went) < LONGEST - 0.02


def pushed(way: tuple[float, float], aside: float = 0.0, **unknown: Any) -> np.ndarray:
    """Where a square at the origin comes to that is pushed from the left."""
    given = {"table": np.ones(1), "spread": np.ones(1), "finger": 0.3, "centres": np.zeros((1, 2))}
    with closing(PushTable(SQUARE.layout, FINGER)) as table:
        table.place(np.zeros((1, 3)), np.ones(1, bool), Unknowns(**(given | unknown)))
        table.push(np.array([-0.2 - FINGER, aside]), np.array(way))
        return table.poses()[0]


def test_a_push_through_the_middle_takes_a_token_along() -> None:
    np.testing.assert_allclose(pushed((0.3, 0.0)), [0.3, 0.0, 0.0], atol=0.01)
    assert pushed((0.3, 0.0), aside=0.15)[2] < -0.2  # above the middle it turns to the right
    assert pushed((0.3, 0.0), centres=np.array([[0.0, -0.08]]))[2] < -0.1
    level = pushed((0.2, 0.2), finger=0.0)
    assert pushed((0.2, 0.2), finger=0.6)[1] > level[1] + 0.02  # a rough finger drags it along


def test_smaller_steps_come_to_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = pushed((0.3, 0.05), aside=0.1)
    monkeypatch.setattr(table_module, "_STEP", table_module._STEP / 10)
    np.testing.assert_allclose(pushed((0.3, 0.05), aside=0.1), usual, atol=0.02)


def test_what_is_unknown_is_drawn_for_each_episode() -> None:
    with closing(SQUARE.make(2)) as env:
        env.reset(generators(2))
        drawn = env.unknowns
    for name in ("finger", "table", "spread", "centres"):
        assert not np.array_equal(getattr(drawn[0], name), getattr(drawn[1], name))
    for name in ("finger", "table", "spread"):
        low, high = getattr(PushConfig, f"{name}_friction" if name != "spread" else name)
        assert all(low <= getattr(one, name) <= high for one in drawn)
    assert all(np.linalg.norm(one.centres) <= 0.15 * SQUARE.layout.radii[0] for one in drawn)


@pytest.mark.parametrize("name", ["table", "planner"])
def test_who_learned_nothing_pushes_a_square_into_place(name: str, few_tried: None) -> None:
    with closing(SQUARE.make(6)) as env:
        rival = SQUARE.rivals()[name](env)
        played = play(SQUARE, env, generators(6), rival)
    scores = SQUARE.score(played)
    assert scores["solved"] >= 0.5
    assert scores["pushes"] < 8
    assert scores["coverage"] > 0.7


def test_planners_know_the_middle_all_or_what_is_wrong(few_tried: None) -> None:
    with closing(SQUARE.make(2)) as env:
        env.reset(generators(2))
        own = middle(SQUARE)
        for name, finger in (
            ("planner", own.finger),
            ("planner_told", env.unknowns[1].finger),  # type: ignore[attr-defined]
            ("planner_wrong", 2.0 * own.finger),
        ):
            assert SQUARE.rivals()[name](env)._known(1).finger == finger  # type: ignore[attr-defined]


def test_one_of_two_tokens_is_half_of_the_reward() -> None:
    with closing(TWO.make(1)) as env:
        env.reset(generators(1))
        env.goals[0, :4] = env.corners[0, :4]  # the square lies where it should
        away = np.array([[1, -0.9, 0, -1]], np.float32)  # a short push of the triangle
        assert env.step(away).rewards.tolist() == [-0.5]


@pytest.mark.parametrize("odds", [(1.0, 1.0), (0.0,)])
def test_odds_of_no_tokens_are_refused_where_it_learns(odds: tuple[float, ...]) -> None:
    with pytest.raises(
        ConfigError, match="task.fewer=.* must have at most 1 odds, for 1, 2, ... tokens, with"
    ):
        replace(SQUARE, config=PushConfig(fewer=odds)).check(plays=False)


def test_it_learns_from_fewer_tokens_too_and_is_tested_with_all() -> None:
    task = replace(TWO, config=PushConfig(fewer=(3.0, 1.0)))
    for purpose, counts in (("play", {1, 2}), ("test", {2})):
        with closing(task.make(12, purpose)) as env:  # type: ignore[arg-type]
            seen = env.reset(generators(12))
        assert {*on_table(seen["goals"], task.layout).sum(axis=1).tolist()} == counts


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"count": 2}, "task.count=2, and the set has 1 tokens: set it to at most 1, or choose"),
        (
            {"spread": (2.0, 1.0)},
            "task.spread must be a range, the lower end first, got .2,1.: write it as .1,2.",
        ),
        ({"finger_friction": (0.1,)}, "task.finger_friction must be a range"),
        ({"within": 0.0}, "task.within must be between"),
        ({"pixels": 8}, "task.pixels must be 0 or at least 16, got 8: set it to 128"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        replace(SQUARE, config=PushConfig(**settings))


def test_compute_reward_is_that_of_the_step() -> None:
    with closing(push_env(("square", "small_triangle"))) as env:
        seen, _ = env.reset(seed=3)
        rows = []
        for _ in range(6):
            seen, reward, terminated, _, info = env.step(env.action_space.sample())
            goals = seen["achieved_goal"], seen["desired_goal"]
            assert env.compute_reward(*goals, info) == pytest.approx(reward)
            assert env.compute_terminated(*goals, info) == terminated == info["is_success"]
            rows.append((*goals, reward))
        achieved, desired, rewards = map(np.array, zip(*rows, strict=True))
        np.testing.assert_allclose(env.compute_reward(achieved, desired, {}), rewards)
        own = env.compute_reward(achieved, achieved, {})
        assert own.tolist() == [0.0] * 6


def test_an_episode_does_not_hang_on_a_push_before_it() -> None:
    given = Unknowns(np.ones(1), np.ones(1), 0.3, np.zeros((1, 2)))
    found = []
    with closing(PushTable(SQUARE.layout, FINGER)) as table:
        for before in (0.5, 1e-4):
            table.place(np.zeros((1, 3)), np.ones(1, bool), given)
            table.push(np.array([0.6, 0.6]), np.array([before, 0.0]))
            table.place(np.zeros((1, 3)), np.ones(1, bool), given)
            table.push(np.array([-0.2 - FINGER, 0.1]), np.array([0.3, 0.0]))
            found.append(table.poses())
    np.testing.assert_array_equal(found[0], found[1])


def test_tokens_without_room_are_refused_before_they_are_played() -> None:
    large = replace(SQUARE, tokens=TokensConfig(("square",), 9.0))
    with pytest.raises(SamplingError, match="no room for square on a table of width 2: lower tok"):
        large.check(plays=True)


def test_what_is_beyond_the_action_space_is_cut() -> None:
    with closing(push_env()) as env, closing(push_env()) as other:
        for one in (env, other):
            one.reset(seed=1)
        far, cut = np.array([-3, 0.2, 5, 9], np.float32), np.array([-1, 0.2, 1, 1], np.float32)
        np.testing.assert_array_equal(
            env.step(far)[0]["observation"], other.step(cut)[0]["observation"]
        )


def test_what_pictures_show_is_near_and_equal_tokens_keep_their_names() -> None:
    equal = TokensConfig(("small_triangle", "small_triangle", "square"), 0.6)
    task = Push(equal, PushConfig(pixels=128))
    with closing(task.make(4)) as env:
        seen, rng = env.reset(generators(4)), np.random.default_rng(3)
        for share in (1.0, 0.8, 0.8):  # that is seen: of tokens that touch not always all
            distance, turn = errors(task.layout, seen["corners"], env.facts()["corners"])
            assert distance.min() > 0.0
            assert ((distance < 0.003) & (turn < 0.02)).mean() >= share
            seen = env.step(rng.uniform(-1.0, 1.0, (4, 4)).astype(np.float32)).seen


@pytest.mark.parametrize("scale", [0.8, 0.05])
def test_the_middle_of_a_row_comes_before_its_second_end(scale: float) -> None:
    layout = Push(TokensConfig(("square", "square", "square"), scale), PushConfig(count=3)).layout
    side = float(np.ptp(layout.body[:4, 0]))
    goals = layout.corners(np.array([[-side, 0.0, 0.0], [0.0, 0.0, 0.0], [side, 0.0, 0.0]]))
    away = np.array([[-0.7, 0.7, 0.0], [0.0, 0.7, 0.0], [0.7, 0.7, 0.0]])
    for placed, following in (
        ([0, 0, 0], [1, 1, 1]),
        ([1, 0, 0], [0, 1, 0]),
        ([0, 1, 0], [1, 0, 1]),
        ([1, 0, 1], [0, 1, 0]),
        ([1, 1, 1], [0, 0, 0]),
    ):
        lies = np.array(placed, np.bool_)
        found = come_next(layout, layout.corners(away), goals, lies)
        assert found.astype(int).tolist() == following
    poses = np.array([[-side, 0.0, 0.0], [0.7, 0.7, 0.0], [side / 2.0, 0.35 * side, 0.0]])
    found = come_next(layout, layout.corners(poses), goals, np.array([True, False, False]))
    assert found.tolist() == [False, True, True]  # the last lies in the middle


def test_odds_of_more_tokens_than_there_are_are_for_learning_alone() -> None:
    two = Push(TokensConfig(SEVEN, 0.6), PushConfig(count=2, fewer=(0.0, 0.0, 1.0)))
    two.check(plays=True)
    with closing(two.make(2)) as env:
        seen = env.reset(generators(2))
    assert (on_table(seen["goals"], two.layout).sum(axis=1) == 2).all()
    with pytest.raises(ConfigError, match="task.fewer=.0,0,1. must have at most 2 odds"):
        two.check(plays=False)


def test_layouts_that_find_room_now_and_then_are_refused() -> None:
    with pytest.raises(SamplingError, match="no room for square, square, square, square on a"):
        Push(TokensConfig(("square",) * 4, 1.7)).check(plays=False)


def test_no_push_is_left_in_place_and_more_are_further_away(few_tried: None) -> None:
    ways = SQUARE.layout.shapes[0], (0.35, 1.45), FINGER, LONGEST, 0.03, 0.1, 0.5
    _, left = alone_module.tried_alone(*ways)
    found = left(np.array([[0.02, 0, 0.05], [0.0, 0.02, np.pi / 2], [0.2, 0, 0], [1.5, 1.5, 0.7]]))
    np.testing.assert_allclose(found[:2], [0.5 * np.hypot(2 / 3, 1 / 2), 1 / 3])
    assert 1.0 <= found[2] < found[3]


def test_gaps_of_convex_polygons_are_negative_where_they_overlap() -> None:
    square = np.array([[0, 1, 1 + 1j, 1j]])
    others = np.stack([square[0] + 1.5, square[0] + 0.9j, square[0] + 0.2 + 0.4j])
    np.testing.assert_allclose(rival_module._gaps(square, others), [0.5, -0.1, -0.6])


def test_rivals_push_what_comes_next_and_others_where_that_cannot_be(
    few_tried: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = SOME.layout
    poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [9.0, 9.0, 0.0]])
    present = np.array([True, True, False])
    corners = corners_of(layout, poses, present)
    goals = corners_of(layout, poses + [0.0, 0.4, 0.0], present)
    with closing(SOME.make(1)) as env:
        planner = rival_module.Planner(SOME, env, 600)  # type: ignore[arg-type]
    for following, pushed in (([0, 1, 0], {1}), ([1, 0, 0], {0}), ([0, 0, 0], {0, 1})):
        next_ones = np.array(following, np.bool_)
        monkeypatch.setattr(rival_module, "come_next", lambda *_, found=next_ones: found)
        found, tokens = planner._proposed(corners, goals, np.zeros((0, 4)))
        assert (
            {*((found[:, 0] + 1.0) / 2.0 * 3).astype(int).tolist()} == pushed == {*tokens.tolist()}
        )
        others, _ = planner._proposed(corners, goals, found[:2])  # made here already
        np.testing.assert_array_equal(others, found[2:])
