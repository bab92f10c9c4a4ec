"""Players follow the curriculum by the number of updates of the weights that they have."""

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from tangram_sim.batch import BatchedEnv
from tests.agent.pair_scenes import PERCEPTRON, seven
from worker.rollout import Rollout

pytestmark = pytest.mark.fast

STAGES = [
    {"updates": 0, "tokens": 1, "targets": "gaussian", "spread": 0.3},
    {"updates": 10, "tokens": 4},
    {"updates": 20},
]


def first_tokens(_corners: Any, placed: np.ndarray, *_others: Any) -> np.ndarray:
    """Actions that name the first token that is left, and leave it where it is."""
    token = np.argmin(placed, axis=1)
    still = np.zeros((len(placed), 3))
    return np.column_stack([(2.0 * token + 1.0) / 7 - 1.0, still]).astype(np.float32)


@pytest.mark.parametrize(
    ("updates", "moved"), [(0, 1), (9, 1), (10, 4), (19, 4), (20, 7), (10_000, 7)]
)
def test_so_many_tokens_are_to_be_moved(updates: int, moved: int) -> None:
    made = seven({}, PERCEPTRON, stages=STAGES)
    with closing(BatchedEnv(made.layout, made.sim, made.reward, 3)) as env:
        rollout = Rollout(env, 5, "player", 0, 0)
        rollout.follow(updates)
        episodes = rollout.play(first_tokens)
    assert (episodes.placed[:, 0].sum(axis=1) == 7 - moved).all()
    # Those lie on their targets already.
    gap = np.abs(episodes.corners[:, 0] - episodes.goals).max(axis=2)
    done = episodes.placed[:, 0][:, made.layout.token_of_corner].astype(np.bool_)
    assert gap[done].max(initial=0.0) < 1e-6
    assert gap[~done].min() > 0.0


def test_a_stage_lasts_until_other_weights_come() -> None:
    made = seven({}, PERCEPTRON, stages=STAGES)
    with closing(BatchedEnv(made.layout, made.sim, made.reward, 1)) as env:
        rollout = Rollout(env, 5, "player", 0, 0)
        found = []
        for updates in (0, None, 10, None, 0):
            if updates is not None:
                rollout.follow(updates)
            found.append(7 - int(rollout.play(first_tokens).placed[0, 0].sum()))
    assert found == [1, 1, 4, 4, 1]


def test_without_stages_the_whole_task_is_played() -> None:
    made = seven({}, PERCEPTRON)
    with closing(BatchedEnv(made.layout, made.sim, made.reward, 1)) as env:
        rollout = Rollout(env, 5, "player", 0, 0)
        before = env.task
        rollout.follow(1000)
        assert env.task == before == made.sim.task
