"""The replay of whole episodes: which are kept, and which goals take the desired one's place."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from tangram_agent.flat.config import BaseConfig
from tangram_agent.flat.replay import EpisodeReplay, Transitions, later
from tangram_core.agent import Streams
from tangram_core.arrays import Singles
from tangram_core.errors import RunError
from tangram_core.spec import Episodes
from tests.agent.agents.goal.worlds import Line

pytestmark = pytest.mark.fast

TASK = Line()
CONFIG = BaseConfig(batch_size=400, relabel_share=0.5)


def streams(seed: int = 0) -> Streams:
    return {
        name: np.random.default_rng([seed, i]) for i, name in enumerate(("replay", "hindsight"))
    }


def episodes(*numbers: int, moves: bool = True) -> Episodes:
    """Episode n stands at 100 n + t at moment t, or at 100 n if it never moves."""
    made = TASK.spec.empty(len(numbers))
    for row, number in enumerate(numbers):
        made["place"][row, :, 0] = 100 * number + np.arange(5) * moves
        made["goal"][row] = -1
        made["actions"][row, :, 0] = np.arange(4) / 10
        made["rewards"][row] = -1
    return made


def replay(capacity: int, *batches: Episodes) -> EpisodeReplay:
    made = EpisodeReplay(TASK, capacity)
    for batch in batches:
        made.add(batch)
    return made


@dataclass
class Found:
    """A batch as `Transitions` names it: places before and after, goals, and all the rest."""

    before: Singles
    after: Singles
    goal: Singles
    actions: Singles
    rest: Transitions


def sample(kept: EpisodeReplay, config: BaseConfig = CONFIG, seed: int = 0) -> Found:
    rest = kept.sample(config, streams(seed))
    rows, steps, goals = map(torch.from_numpy, (rest.rows, rest.steps, rest.desired))
    before, after = (kept.seen(rows, moments, goals) for moments in (steps, steps + 1))
    assert before["goal"] is after["goal"] is goals
    places = (seen["place"][:, 0].numpy() for seen in (before, after))
    actions = kept.actions(rows, steps)[:, 0].numpy()
    return Found(*places, rest.desired[:, 0], actions, rest)


def numbers(kept: EpisodeReplay) -> set[int]:
    return set((sample(kept).before // 100).astype(int).tolist())


def test_the_newest_episodes_are_kept() -> None:
    kept = replay(4 * 3, episodes(1, 2), episodes(3), episodes(4, 5))
    assert len(kept) == 3
    assert numbers(kept) == {3, 4, 5}
    assert numbers(replay(4 * 3, episodes(1, 2, 3, 4, 5))) == {3, 4, 5}


def test_a_batch_has_what_followed_and_what_it_was_worth() -> None:
    found = sample(replay(100, episodes(1, 2, 3)))
    before, after, goal = found.before, found.after, found.goal
    assert (after == before + 1).all()
    assert found.actions == pytest.approx((before % 100) / 10)
    relabelled = goal != -1
    assert 0.4 < relabelled.mean() < 0.6
    assert (goal[relabelled] >= after[relabelled]).all()  # of this episode, and of a later moment
    assert (goal[relabelled] < before[relabelled] + 5).all()
    assert (found.rest.rewards == np.where(goal == after, 0, -1)).all()
    assert (found.rest.terminated == (goal == after)).all()


def test_without_hindsight_all_is_as_it_was_played() -> None:
    found = sample(replay(100, episodes(1, 2)), replace(CONFIG, relabel_share=0.0))
    assert (found.goal == -1).all()
    assert (found.rest.rewards == -1).all()
    assert not found.rest.terminated.any()


def test_goals_are_of_later_moments() -> None:
    for step, moments in {0: {1, 2, 3, 4}, 2: {3, 4}, 3: {4}}.items():
        found = later(np.full(200, step), np.full(200, 4), np.random.default_rng(0))
        assert set(found.tolist()) == moments


def test_a_share_comes_of_episodes_that_moved() -> None:
    kept = replay(1000, episodes(*range(1, 10), moves=False), episodes(10))
    found = sample(kept, CONFIG)
    assert 0.45 < (found.before >= 1000).mean() < 0.65
    still = replay(1000, episodes(1, 2, moves=False))  # none moved: any will do
    assert len(sample(still, CONFIG).before) == 400


@pytest.mark.parametrize("added", [2, 3, 7])
def test_a_replay_goes_on_from_its_state(added: int) -> None:
    kept = replay(4 * 3, *(episodes(n) for n in range(added)))
    other = EpisodeReplay(TASK, 4 * 3)
    other.load_state(kept.state())
    for one in (kept, other):
        one.add(episodes(99))
    first, second = (sample(one, seed=5) for one in (kept, other))
    assert (first.before == second.before).all()
    assert (first.goal == second.goal).all()


@pytest.mark.parametrize("capacity", [2, 3, 5])
def test_a_replay_of_another_size_keeps_the_newest(capacity: int) -> None:
    kept = replay(4 * 3, *(episodes(n) for n in range(1, 8)))
    other = EpisodeReplay(TASK, 4 * capacity)
    other.load_state(kept.state())
    newest = set(range(8 - min(3, capacity), 8))
    assert numbers(other) == newest
    third = EpisodeReplay(TASK, 4 * 3)
    third.load_state(other.state())
    assert numbers(third) == newest
    other.add(episodes(8))
    assert numbers(other) == ({*newest, 8} if capacity > 3 else set(range(9 - capacity, 9)))


@pytest.mark.parametrize(
    "wrong",
    [
        {"place": np.zeros((2, 4, 1), "f4")},
        {"place": np.zeros((2, 5, 1), "f8")},
        {"place": np.full((2, 5, 1), np.nan, "f4")},
        {"actions": np.full((2, 4, 1), 2, "f4")},
        {"added": np.array([1])},
    ],
)
def test_a_state_that_does_not_fit_is_refused(wrong: dict[str, Any]) -> None:
    state = replay(100, episodes(1, 2)).state()
    with pytest.raises(RunError, match="replay state: '"):
        EpisodeReplay(TASK, 100).load_state(state | wrong)
