"""Pairs out of transitions: which goals they have, and that their labels are exact."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from tangram_agent.agents.pair.batch import PairBatch, make_pairs
from tangram_agent.agents.pair.coverage import covered_share, covering, newly_covered
from tangram_agent.base.types import Transitions
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import chosen_tokens
from tests.agent.agents.pair.pair_scenes import seven, transitions
from tests.agent.builders import setup

pytestmark = pytest.mark.fast

FINAL = {"strategy": "final"}
NEAR = {"strategy": "near", "copies": 2, "position": 0.05, "angle": 0.3}
COUNT, PAIRS = 100, 8
PARALLELOGRAM = 6


MADE = seven()
LAYOUT = MADE.task.layout
BATCH = transitions(MADE, COUNT)
EXACT = {name: column.astype(np.float64) for name, column in BATCH.arrays.items()}
ROWS = np.repeat(np.arange(COUNT), PAIRS)
NAMES = np.array([shape.name for shape in LAYOUT.shapes])
SYMMETRY = np.array([shape.symmetry for shape in LAYOUT.shapes])


def made_pairs(hindsight: list[dict[str, Any]], seed: int = 0) -> PairBatch:
    goals = seven({"hindsight": hindsight}).agent.config.hindsight
    return make_pairs(BATCH, LAYOUT, goals, np.random.default_rng(seed))


def is_played(pairs: PairBatch) -> np.ndarray:
    """Which pairs have the piece of the goal that was played."""
    goals = LAYOUT.poses(EXACT["goal"])[ROWS, pairs.piece.index]
    played: np.ndarray = np.isclose(goals, pairs.piece.pose).all(axis=1)
    return played


def turn_gap(pairs: PairBatch) -> np.ndarray:
    """The angle between token and piece, at the nearest of the turns that look alike."""
    order = SYMMETRY[pairs.piece.index]
    gap: np.ndarray = (
        np.angle(np.exp(1j * order * (pairs.piece.pose - pairs.after.pose)[:, 2])) / order
    )
    return gap


def check_ends(pairs: PairBatch, layout: Layout, batch: Transitions, token: Any) -> None:
    """Poses and sides before and after the action are those of the token that moved."""
    rows = np.repeat(np.arange(COUNT), len(pairs.after.index) // COUNT)
    for lying, corners in ((pairs.before, batch.state), (pairs.after, batch.next_state)):
        exact = corners.astype(np.float64)
        np.testing.assert_allclose(lying.pose, layout.poses(exact)[rows, token])
        sides = layout.flipped(exact)[rows, token]
        np.testing.assert_array_equal(lying.flipped, sides)


def test_the_token_that_moved_before_and_after() -> None:
    pairs = made_pairs([FINAL])
    token = chosen_tokens(EXACT["action"], 7)[ROWS]
    np.testing.assert_array_equal(pairs.after.index, token)
    check_ends(pairs, LAYOUT, BATCH, token)
    assert pairs.before.flipped.any()
    assert pairs.after.flipped.any()


@pytest.mark.parametrize(
    ("hindsight", "share"), [([], 1.0), ([FINAL], 1 / 2), ([FINAL, NEAR], 1 / 4)]
)
def test_the_share_of_goals_that_were_played(hindsight: list[Any], share: float) -> None:
    assert is_played(made_pairs(hindsight)).mean() == pytest.approx(share, abs=0.05)


def test_played_pairs_have_any_piece_and_its_exact_covered_share() -> None:
    pairs = made_pairs([])
    counts = np.bincount(pairs.piece.index, minlength=7) / len(ROWS)
    np.testing.assert_allclose(counts, 1 / 7, atol=0.05)
    sides = LAYOUT.flipped(EXACT["goal"])[ROWS, pairs.piece.index]
    np.testing.assert_array_equal(pairs.piece.flipped, sides)
    table = covering(BATCH.state, BATCH.goal, LAYOUT)
    expected = covered_share(table, LAYOUT)[ROWS, pairs.after.index, pairs.piece.index]
    np.testing.assert_allclose(pairs.covered, expected)
    assert 0.05 < (expected > 0.1).mean() < 0.95


@pytest.mark.parametrize("hindsight", [[], [FINAL, NEAR]])
def test_values_are_what_is_newly_covered(hindsight: list[Any]) -> None:
    pairs = made_pairs(hindsight)
    expected = newly_covered(pairs.after, pairs.piece, pairs.covered, LAYOUT)
    np.testing.assert_array_equal(pairs.reward, expected)
    assert 0.0 <= pairs.reward.min() <= pairs.reward.max() <= 1.0


def test_hindsight_is_where_the_token_came_to_lie_and_mostly_a_piece_of_its_shape() -> None:
    pairs = made_pairs([FINAL])
    hind = ~is_played(pairs)
    np.testing.assert_array_equal(pairs.piece.pose[hind, :2], pairs.after.pose[hind, :2])
    np.testing.assert_allclose(turn_gap(pairs)[hind], 0.0, atol=1e-9)
    own = NAMES[pairs.piece.index] == NAMES[pairs.after.index]
    # Any shape in 15 %, a part of which is the token's own.
    assert own[hind].mean() == pytest.approx(1 - 0.15 * 38 / 49, abs=0.03)
    partly = pairs.covered[hind][pairs.covered[hind] > 0.0]
    assert len(partly) / hind.sum() == pytest.approx(0.3, abs=0.06)
    # Any share, whatever the goal that was played had.
    np.testing.assert_allclose([partly.mean(), partly.std()], [0.5, 12**-0.5], atol=0.06)
    exact = own & hind & (pairs.covered == 0.0) & (pairs.after.flipped == pairs.piece.flipped)
    np.testing.assert_allclose(pairs.reward[exact], 1.0)
    assert exact.sum() > 100


def test_equal_shapes_and_the_turns_that_look_alike_are_all_drawn() -> None:
    pairs = made_pairs([FINAL])
    hind = ~is_played(pairs)
    equal = hind & np.isin(pairs.after.index, (0, 1))
    assert np.bincount(pairs.piece.index[equal])[:2].min() > 0.3 * equal.sum()
    for piece, symmetry in enumerate(SYMMETRY):
        gap = (pairs.piece.pose - pairs.after.pose)[hind & (pairs.piece.index == piece), 2]
        assert set(np.round(gap / (2.0 * np.pi / symmetry), 6)) == set(range(symmetry))


def test_near_misses_have_the_spread_that_is_set() -> None:
    pairs = made_pairs([NEAR])
    near = ~is_played(pairs)
    gap = np.column_stack([(pairs.piece.pose - pairs.after.pose)[:, :2], turn_gap(pairs)])[near]
    np.testing.assert_allclose(gap.mean(axis=0), 0.0, atol=0.04)
    # With four turns that look alike the largest misses are nearer to another one.
    np.testing.assert_allclose(gap.std(axis=0), [0.05, 0.05, 0.29], rtol=0.1)


def test_sides_of_hindsight_are_mostly_the_tokens_own() -> None:
    pairs = made_pairs([FINAL])
    hind = (
        ~is_played(pairs)
        & (pairs.after.index == PARALLELOGRAM)
        & (pairs.piece.index == PARALLELOGRAM)
    )
    same = pairs.piece.flipped[hind] == pairs.after.flipped[hind]
    assert 0.75 < same.mean() < 1.0
    assert not pairs.piece.flipped[pairs.piece.index != PARALLELOGRAM].any()


def test_the_same_generator_gives_the_same_pairs_and_the_transitions_stay() -> None:
    before = {name: column.copy() for name, column in BATCH.arrays.items()}
    one, again, other = (made_pairs([FINAL, NEAR], seed) for seed in (3, 3, 4))
    np.testing.assert_equal(asdict(one), asdict(again))
    assert not np.array_equal(one.piece.pose, other.piece.pose)
    for name, column in BATCH.arrays.items():
        np.testing.assert_array_equal(column, before[name])


def test_a_quarter_of_the_pairs_is_asked_from_where_the_action_ended() -> None:
    pairs = made_pairs([FINAL, NEAR])
    again = (pairs.start.pose == pairs.after.pose).all(axis=1) & (
        pairs.start.pose != pairs.before.pose
    ).any(axis=1)
    assert again.mean() == pytest.approx(0.25, abs=0.05)
    np.testing.assert_array_equal(pairs.start.pose[~again], pairs.before.pose[~again])
    sides = np.where(again, pairs.after.flipped, pairs.before.flipped)
    np.testing.assert_array_equal(pairs.start.flipped, sides)


@pytest.mark.parametrize("shape", ["square", "parallelogram", "large_triangle"])
def test_one_tokens_pairs_are_the_transitions_with_their_reward(shape: str) -> None:
    """As they come out of the replay."""
    made = setup({"shapes": [shape], "scale": 0.8}, {"kind": "pair"}, actions_per_token=2)
    layout, rng = made.task.layout, np.random.default_rng(0)
    reward = rng.uniform(-1.0, 1.0, COUNT).astype(np.float32)
    done = (rng.random(COUNT) < 0.5).astype(np.uint8)
    batch = replace(transitions(made, COUNT), reward=reward, done=done)
    pairs = make_pairs(batch, layout, made.agent.config.hindsight, np.random.default_rng(1))
    np.testing.assert_array_equal(pairs.reward, batch.reward)
    np.testing.assert_array_equal(pairs.done, batch.done)
    np.testing.assert_array_equal(pairs.velocity, batch.action)
    assert not pairs.covered.any()
    goals, sides = layout.poses(batch.goal.astype(np.float64)), layout.flipped(batch.goal)
    np.testing.assert_array_equal(pairs.piece.flipped, sides[:, 0])
    np.testing.assert_array_equal(pairs.piece.pose[:, :2], goals[:, 0, :2])
    order = layout.shapes[0].symmetry
    turns = (pairs.piece.pose - goals[:, 0])[:, 2] * order / (2.0 * np.pi)
    assert set(np.round(turns, 9)) == set(range(order))
    check_ends(pairs, layout, batch, 0)
