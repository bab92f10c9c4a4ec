"""The ring against a naive oracle, and its state in and out."""

from collections import deque

import numpy as np
import pytest

from tangram_agent.base.replay import ReplayBuffer
from tangram_agent.base.types import Transitions
from tangram_core.errors import RunError
from tests.agent.builders import PAIR, random_transitions, setup

pytestmark = pytest.mark.fast

MADE = setup(PAIR)


def buffer(capacity: int) -> ReplayBuffer:
    return ReplayBuffer(capacity, MADE.task.layout.corner_count, 2, 4)


def numbered(first: int, count: int) -> Transitions:
    """Transitions whose reward is their number."""
    batch = random_transitions(MADE, count, seed=first)
    return Transitions(**{**batch.arrays, "reward": np.arange(first, first + count, dtype="f4")})


def rewards(replay: ReplayBuffer) -> list[float]:
    return sorted(replay.state()["reward"].tolist())


@pytest.mark.parametrize("seed", range(10))
def test_equals_a_naive_oracle_under_random_operations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    capacity = int(rng.integers(1, 20))
    replay, oracle, number = buffer(capacity), deque(maxlen=capacity), 0
    rows: dict[float, Transitions] = {}
    for _ in range(60):
        match rng.integers(3):
            case 0:
                count = int(rng.integers(1, 2 * capacity + 2))
                batch = numbered(number, count)
                replay.add(batch)
                for i in range(count):
                    oracle.append(float(number + i))
                    parts = {name: column[i : i + 1] for name, column in batch.arrays.items()}
                    rows[float(number + i)] = Transitions(**parts)
                number += count
            case 1 if oracle:
                drawn = replay.sample(7, rng)
                assert drawn.count == 7
                for i, reward in enumerate(drawn.reward.tolist()):
                    assert reward in oracle
                    for name, column in drawn.arrays.items():
                        np.testing.assert_array_equal(column[i], getattr(rows[reward], name)[0])
            case _:
                if seed % 2:  # a restart with room for more or fewer
                    capacity = int(rng.integers(1, 20))
                    oracle = deque(oracle, maxlen=capacity)
                fresh = buffer(capacity)
                fresh.load_state({k: v.copy() for k, v in replay.state().items()})
                replay = fresh
        replay.check_valid(replay.state())
        assert len(replay) == len(oracle)
        assert replay.added == number
        assert rewards(replay) == sorted(oracle)


@pytest.mark.parametrize(("added", "kept"), [(14, range(5, 15)), (6, range(1, 7))])
def test_samples_every_kept_transition_alike_and_no_other(added: int, kept: range) -> None:
    replay = buffer(10)
    with pytest.raises(ValueError, match="empty replay"):
        replay.sample(1, np.random.default_rng(0))
    replay.add(numbered(1, added))
    drawn = replay.sample(2000 * len(kept), np.random.default_rng(0)).reward
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == list(kept)
    assert counts.min() > 1800
    assert counts.max() < 2200


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("reward", np.nan, "'reward' must be float32"),
        ("goal", np.inf, "'goal' must be float32"),
        ("done", 2, "'done' must be uint8 .* within 0 and 1"),
    ],
)
def test_bad_numbers_are_found_and_not_taken_over(name: str, value: float, reason: str) -> None:
    replay = buffer(4)
    replay.add(numbered(0, 2))
    buffer(4).load_state(replay.state())
    replay.state()[name].reshape(-1)[0] = value
    with pytest.raises(RunError, match=reason):
        buffer(4).load_state(replay.state())


@pytest.mark.parametrize("name", ["reward", "state", "added", None])
def test_a_state_with_a_missing_column_or_of_another_layout_is_refused(name: str | None) -> None:
    replay = buffer(4)
    replay.add(numbered(0, 2))
    state = {own: column for own, column in replay.state().items() if own != name}
    other = buffer(4) if name else ReplayBuffer(4, 4, 1, 3)
    with pytest.raises(RunError, match="it belongs to another task"):
        other.load_state(state)
