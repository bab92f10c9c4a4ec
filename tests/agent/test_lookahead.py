"""Looking ahead among tokens that push each other: in the engine, with guides that know it all."""

from contextlib import closing
from typing import Any, cast

import numpy as np
import pytest

from tangram_agent import contacts
from tangram_agent.foresight import EngineWorlds, Table
from tangram_agent.lookahead import Lookahead
from tangram_agent.networks import Networks
from tangram_agent.pairs import PairGraph
from tangram_agent.planning import Planner
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.types import Past
from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.batch import BatchedEnv
from tests.agent.builders import setup
from tests.agent.pair_scenes import PERCEPTRON, PerfectCritic, PerfectNetworks, seven
from worker.baselines import exact_policy
from worker.rollout import Choose
from worker.sweeping import SweepGuide, sweeping_policy

pytestmark = pytest.mark.fast

TOKENS = {"shapes": ["square", "medium_triangle"], "scale": 0.6}
SLIDE = {"backend": "physics", "motion": "slide"}
# The second token comes from the left and goes through the first one's place.
STARTS, GOALS = ((-0.6, 0.7, 0), (-0.7, 0, 0)), ((0, 0, 0), (0.7, 0, 0))
# And the first one from the right, through the second one's: each order costs.
CROSSED = ((0.9, 0, 0), (-0.8, 0, 0)), ((0, 0, 0), (0.45, 0, 0))


def two(agent: dict[str, Any] | None = None, **sim: Any) -> Setup:
    return setup(TOKENS, {"lookahead": "engine"} | (agent or {}), PERCEPTRON, **SLIDE, **sim)


def perfect(made: Setup, pushes: Any = None) -> Planner:
    graph = PairGraph(made.layout, made.sim.arena, made.agent)
    table = None if pushes is None else np.array(pushes)
    networks = PerfectNetworks(PerfectCritic(made.layout, table), graph)
    return Planner(cast("Networks", networks), made)


def as_choose(planner: Planner, made: Setup) -> Choose:
    policy = Policy(made)
    policy._planner = planner  # perfect networks have no weights to load

    def choose(corners: Floats, placed: Bools, goals: Floats, _g: Any, past: Past) -> Any:
        return policy.act(corners, placed, goals, past=past)

    return choose


def played(made: Setup, choose: Choose, starts: Any, goals: Any) -> tuple[list[int], float]:
    """The tokens that move, in turn, and what is covered in the end."""
    layout = made.layout
    with closing(BatchedEnv(layout, made.sim, made.reward)) as env:
        targets = np.array([goals], np.float64), np.zeros((1, layout.tokens), np.bool_)
        env.reset([np.random.default_rng(0)], targets)
        env._worlds[0].place(np.array(starts, np.float64))
        env._look()
        moved, shown, actions = list[int](), [env.seen], list[Any]()
        for _ in range(env.horizon):
            before = env.corners
            past = Past(np.stack(shown[:-1] or shown, 1)[:, : len(actions)], _stacked(env, actions))
            action = choose(env.seen, env.placed, env.seen_goals, [], past)
            result = env.step(action.astype(np.float64))
            if np.abs(env.corners - before).max() > 1e-6:
                moved.append(int(result.tokens[0]))
            shown.append(env.seen)
            actions.append(action)
        return moved, float(result.overlap[0])


def _stacked(env: BatchedEnv, actions: list[Any]) -> Any:
    return np.stack(actions, 1) if actions else np.zeros((1, 0, env.action_size), np.float32)


def test_the_order_that_pushes_nothing_away_is_found() -> None:
    made = two()
    assert played(made, exact_policy(made.layout, made.sim), STARTS, GOALS)[0] == [0, 1]
    for choose in (
        sweeping_policy(made.layout, made.sim, EngineWorlds(made.layout, made.sim), 1),
        as_choose(perfect(made, [[0, 0], [1, 0]]), made),
        as_choose(perfect(made), made),  # a guide that knows nothing: the engine tells
    ):
        moved, covered = played(made, choose, STARTS, GOALS)
        assert moved == [1, 0]
        assert covered == pytest.approx(1.0, abs=1e-3)


def test_with_two_actions_a_token_goes_round_what_is_in_its_way() -> None:
    one, both = (two(actions_per_token=count) for count in (1, 2))
    covered = [
        played(
            made,
            sweeping_policy(made.layout, made.sim, EngineWorlds(made.layout, made.sim), 4),
            *CROSSED,
        )[1]
        for made in (one, both)
    ]
    assert covered[0] < 0.9
    assert covered[1] == pytest.approx(1.0, abs=1e-3)


def test_a_token_that_was_pushed_is_put_back_while_it_has_actions() -> None:
    made = two(actions_per_token=2)
    layout, moved = made.layout, np.array([[[0.1, 0.0, 0.3], [0.7, 0.0, 0.0]]])
    choose = sweeping_policy(layout, made.sim, EngineWorlds(layout, made.sim), 1)
    corners, goals = layout.corners(moved), layout.corners(np.array([GOALS], np.float64))
    spent = np.array([[False, True]])
    first, second = (
        Past(np.zeros((1, count, 7, 2), np.float32), np.full((1, count, 4), -0.5, np.float32))
        for count in (1, 2)
    )
    action = choose(corners, spent, goals, [], first)
    np.testing.assert_allclose(action, [[-0.5, -0.05, 0.0, -0.3 / np.pi]], atol=1e-6)
    np.testing.assert_array_equal(choose(corners, spent, goals, [], second), [[-0.5, 0, 0, 0]])


class Watched(EngineWorlds):
    """Counts the actions that are tried."""

    moves = 0

    def slid(self, table: Table, token: Ints, way: Floats) -> Floats:
        self.moves += len(token)
        return super().slid(table, token, way)


def test_it_keeps_to_its_plan_while_the_world_does_what_was_foreseen() -> None:
    made = two()
    layout, world = made.layout, Watched(made.layout, made.sim)
    ahead = Lookahead(layout, made.sim, SweepGuide(layout), world, 2)
    goals, placed = layout.corners(np.array([GOALS], np.float64)), np.array([[False, False]])

    def choose(poses: Any, placed: Bools) -> int:
        token, _ = ahead.choose(layout.corners(np.array([poses], np.float64)), placed, goals, None)
        return int(token[0])

    assert choose(STARTS, placed) == 1
    tried, placed = world.moves, np.array([[False, True]])
    assert tried > 2
    assert choose((STARTS[0], GOALS[1]), placed) == 0
    assert world.moves == tried
    assert choose((STARTS[0], (0.7, 0.01, 0)), placed) == 0  # the other one is not where it was
    assert world.moves > tried


def test_a_plan_that_leaves_a_part_is_made_again_at_the_next_action() -> None:
    made = two()
    layout, world = made.layout, Watched(made.layout, made.sim)
    ahead = Lookahead(layout, made.sim, SweepGuide(layout), world, 1)
    starts, goals = (layout.corners(np.array([poses], np.float64)) for poses in CROSSED)
    moved, _ = ahead.choose(starts, np.zeros((1, 2), np.bool_), goals, None)
    [first], tried = ahead._plans.values(), world.moves
    assert first.covered < 0.98
    placed = np.arange(2) == moved
    ahead.choose(layout.corners(first.steps[0].before[None]), placed[None], goals, None)
    [second] = ahead._plans.values()
    assert world.moves > tried
    assert second.covered >= first.covered


def test_a_broader_beam_tries_more(monkeypatch: pytest.MonkeyPatch) -> None:
    worlds = list[Watched]()

    def watched(*given: Any) -> Watched:
        worlds.append(Watched(*given))
        return worlds[-1]

    monkeypatch.setattr(contacts, "EngineWorlds", watched)
    goals, starts = np.zeros((2, 7, 3))
    goals[:, 0], goals[:, 1] = np.linspace(-0.9, 0.9, 7), 0.3
    starts[:, 0], starts[:, 1] = goals[::-1, 0], -0.3
    for beam in (1, 3):
        made = seven({"lookahead": "engine", "beam": beam}, PERCEPTRON, **SLIDE)
        placed = np.arange(7)[None] > 2
        perfect(made).choose(
            made.layout.corners(starts[None]), placed, made.layout.corners(goals[None])
        )
    assert worlds[0].moves < worlds[1].moves


def test_planning_leaves_the_world_that_is_played_as_it_is() -> None:
    """And is the same every time, whatever was planned before."""
    made = seven({"lookahead": "engine", "beam": 1}, PERCEPTRON, starts="outside", **SLIDE)
    ends = []
    for rounds in (0, 1, 2):
        choose = sweeping_policy(made.layout, made.sim, EngineWorlds(made.layout, made.sim), 1)
        with closing(BatchedEnv(made.layout, made.sim, made.reward)) as env:
            env.reset([np.random.default_rng(3)])
            none = Past(np.zeros((1, 0, 0, 2), np.float32), np.zeros((1, 0, 4), np.float32))
            for _ in range(rounds):
                action = choose(env.corners, env.placed, env.goals, [], none)
                choose(env.corners[:, ::-1][:, ::-1] + 0.1, env.placed, env.goals + 0.1, [], none)
            if rounds:
                np.testing.assert_array_equal(
                    action, choose(env.corners, env.placed, env.goals, [], none)
                )
            env.step(np.array([[0.0, 0.3, -0.2, 0.5]]))
            ends.append(env.corners)
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


def test_what_is_in_the_way_is_seen_by_its_depth() -> None:
    made = two()
    guide = SweepGuide(made.layout)
    table = Table(
        np.array(STARTS, np.float64),
        np.zeros(2, np.bool_),
        np.array(GOALS, np.float64),
        np.zeros(2, np.bool_),
    )
    start, end = table.poses[[1, 1]], np.array([GOALS[1], (-0.7, 0.5, 0.0)], np.float64)
    pushed = guide.pushed(table, np.array([1, 1]), start, end)
    assert pushed[0, 0] == 1.0  # through the middle of the square's place
    assert not pushed[1].any()


def test_a_token_that_seems_to_lie_on_its_other_side_goes_nowhere() -> None:
    """As noise on the corners may show it: no piece is its own then."""
    made = setup({"shapes": ["square", "parallelogram"], "scale": 0.6}, {}, PERCEPTRON, **SLIDE)
    layout, poses = made.layout, np.array([[(0.0, 0, 0), (0.7, 0, 0)]])
    seen = layout.corners(poses + [0.0, 0.1, 0.0], np.array([[False, True]]))
    none = Past(np.zeros((1, 0, 0, 2), np.float32), np.zeros((1, 0, 4), np.float32))
    choose = sweeping_policy(layout, made.sim, EngineWorlds(layout, made.sim), 2)
    action = choose(seen, np.array([[True, False]]), layout.corners(poses), [], none)
    assert np.isfinite(action).all()


def test_other_weights_begin_with_no_plans() -> None:
    policy = Policy(two())
    planner = policy._planner
    assert planner is not None
    planner._lookahead._plans[b"somewhere"] = ()
    policy.load(policy.weights())
    assert not planner._lookahead._plans
