"""Tables: a trajectory in, the exact transitions out."""

import numpy as np
import pytest

from tangram_agent.base.config import RelabelConfig
from tangram_agent.base.relabelling import flatten, with_relabelled
from tangram_agent.base.types import Transitions
from tangram_core.spec import Episodes
from tests.agent.builders import random_episodes, setup

pytestmark = pytest.mark.fast

STEPS = 3
MADE = setup(actions_per_token=STEPS)
LAYOUT = MADE.task.layout
# One episode of three steps along x; S[t] are the corners at time t, G is the played goal.
S = LAYOUT.corners(np.array([[[0.1 * t, 0.0, 0.0]] for t in range(4)])).astype(np.float32)
G = LAYOUT.corners(np.array([[0.0, 0.8, 0.0]])).astype(np.float32)
A = np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.3, 0.0, 0.0]], np.float32)
EPISODE = Episodes(
    {
        "corners": S[None],
        "placed": np.array([[[0], [0], [0], [1]]], np.uint8),
        "goals": G[None],
        "actions": A[None],
        "rewards": np.array([[-0.9, -0.8, -0.7]], np.float32),
        "terminated": np.array([[0, 0, 1]], np.uint8),
    }
)


def same(achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """+1 where the goal is reached exactly, minus the distance of the first corner elsewhere."""
    gap = np.linalg.norm(achieved[:, 0] - desired[:, 0], axis=-1)
    return np.where(gap < 1e-6, 1.0, -gap)


def rows(batch: Transitions) -> list[tuple[object, ...]]:
    """(time of s, action, reward, time of s', placed before and after, d, goal) per transition."""

    def time_of(points: np.ndarray) -> int | str:
        hits = [t for t in range(4) if np.allclose(points, S[t])]
        return hits[0] if hits else "G" if np.allclose(points, G) else "?"

    flags = [batch.placed[:, 0], batch.next_placed[:, 0], batch.done]
    return [
        (
            time_of(batch.state[i]),
            round(float(batch.action[i, 0]), 3),
            round(float(batch.reward[i]), 3),
            time_of(batch.next_state[i]),
            *(int(flag[i]) for flag in flags),
            time_of(batch.goal[i]),
        )
        for i in range(batch.count)
    ]


def test_only_where_a_step_terminated_does_nothing_follow() -> None:
    assert flatten(EPISODE).done.tolist() == [0, 0, 1]
    limited = Episodes({**EPISODE.arrays, "terminated": np.zeros((1, 3), np.uint8)})
    assert flatten(limited).done.tolist() == [0, 0, 0]  # a time limit


PLAYED = [
    (0, 0.1, -0.9, 1, 0, 0, 0, "G"),
    (1, 0.2, -0.8, 2, 0, 0, 0, "G"),
    (2, 0.3, -0.7, 3, 0, 1, 1, "G"),
]


def relabelled(*kinds: RelabelConfig, seed: int = 0) -> Transitions:
    return with_relabelled(EPISODE, kinds, LAYOUT, same, np.random.default_rng(seed))


def test_what_was_played_stays_and_none_adds_nothing() -> None:
    assert rows(flatten(EPISODE)) == PLAYED
    assert rows(relabelled()) == PLAYED


def test_final_goals_end_in_success() -> None:
    assert rows(relabelled(RelabelConfig("final"))) == [
        *PLAYED,
        (0, 0.1, -0.2, 1, 0, 0, 0, 3),
        (1, 0.2, -0.1, 2, 0, 0, 0, 3),
        (2, 0.3, 1.0, 3, 0, 1, 1, 3),
    ]


def test_future_goals_take_a_state_from_this_step_on() -> None:
    seen: set[tuple[object, object]] = set()
    for seed in range(40):
        for row in rows(relabelled(RelabelConfig("future"), seed=seed))[3:]:
            reached, goal, reward = row[3], row[7], row[2]
            seen.add((reached, goal))
            assert reward == (1.0 if goal == reached else pytest.approx(0.1 * (reached - goal)))
    assert seen == {(1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3)}


def test_near_goals_are_the_final_pose_moved_a_little() -> None:
    episodes = random_episodes(MADE, 400)
    kind = RelabelConfig("near", position=0.05, angle=0.3)
    batch = with_relabelled(episodes, (kind,), LAYOUT, same, np.random.default_rng(1))
    goals = LAYOUT.poses(batch.goal[1200:].astype(np.float64))[:, 0]
    finals = LAYOUT.poses(episodes["corners"][:, -1].astype(np.float64))[:, 0]
    gap = goals - np.repeat(finals, STEPS, axis=0)
    gap[:, 2] = (gap[:, 2] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(gap.mean(axis=0), 0.0, atol=0.03)
    np.testing.assert_allclose(gap.std(axis=0), [0.05, 0.05, 0.3], rtol=0.1)
    sides = np.linalg.norm(batch.goal[:, 0] - batch.goal[:, 1], axis=1)
    np.testing.assert_allclose(sides, 0.4, atol=1e-5)


def test_copies_and_kinds_stand_one_after_the_other() -> None:
    batch = relabelled(RelabelConfig("final", copies=2), RelabelConfig("near", position=1.0))
    found = rows(batch)
    assert found[:3] == PLAYED
    assert [row[7] for row in found[3:9]] == [3] * 6
    assert [row[7] for row in found[9:]] == ["?"] * 3


def test_near_goals_lie_on_the_side_that_was_reached() -> None:
    made = setup({"shapes": ["parallelogram"], "scale": 1.0}, actions_per_token=STEPS)
    layout = made.task.layout
    path = np.array([[[0.1 * t, 0.0, 0.0]] for t in range(4)])
    corners = layout.corners(path, np.ones((4, 1), dtype=bool)).astype(np.float32)
    there = {"corners": corners[None], "goals": corners[None, 0]}
    episode = Episodes({**EPISODE.arrays, **there})
    kind = RelabelConfig("near", copies=20, position=0.01, angle=0.1)
    batch = with_relabelled(episode, [kind], layout, same, np.random.default_rng(0))
    assert layout.flipped(batch.goal.astype(np.float64)).all()
