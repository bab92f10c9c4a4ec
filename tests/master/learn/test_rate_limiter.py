"""The rate limiter: exact tables, and never a state in which nobody may move."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from master.learn.rate_limiter import RateLimiter
from tangram_core.errors import ConfigError, RunError

pytestmark = pytest.mark.fast


@pytest.mark.parametrize(
    ("settings", "transitions", "updates", "lag", "may_update", "may_insert"),
    [  # settings: rate, starts, limit
        # Nothing is due before learning starts; with the last of them all is.
        ((0.5, 10, 4), 0, 0, 0, False, True),
        ((0.5, 10, 4), 9, 0, 0, False, True),
        ((0.5, 10, 4), 10, 0, 5, True, False),
        # The lag's bound: at it no insert, below it both.
        ((0.5, 10, 4), 10, 1, 4, True, False),
        ((0.5, 10, 4), 10, 2, 3, True, True),
        ((0.5, 10, 4), 10, 4, 1, True, True),
        # Up to date: the learner waits.
        ((0.5, 10, 4), 10, 5, 0, False, True),
        # Half an update is none.
        ((0.5, 10, 4), 11, 5, 0, False, True),
        ((0.5, 10, 4), 12, 5, 1, True, True),
        # More updates than transitions.
        ((4.0, 1, 1), 1, 0, 4, True, False),
        ((4.0, 1, 1), 1, 3, 1, True, False),
        ((4.0, 1, 1), 1, 4, 0, False, True),
        # 0.29 * 100 is 28.999999999999996.
        ((0.29, 1, 9), 100, 28, 1, True, True),
        # Ahead, after a restore with other settings.
        ((0.5, 1, 9), 10, 7, 0, False, True),
    ],
)
def test_what_is_allowed(
    settings: tuple[float, int, int],
    transitions: int,
    updates: int,
    lag: int,
    may_update: bool,
    may_insert: bool,
) -> None:
    limiter = RateLimiter(*settings)
    limiter.inserted(transitions)
    limiter.updated(updates)
    found = (limiter.transitions, limiter.updates, limiter.lag)
    assert found == (transitions, updates, lag)
    assert (limiter.may_update(), limiter.may_insert()) == (may_update, may_insert)


@given(
    st.floats(1e-3, 100),
    st.integers(0, 50),
    st.integers(1, 20),
    st.lists(st.tuples(st.booleans(), st.integers(1, 40)), max_size=60),
)
def test_somebody_may_always_move_and_nobody_runs_ahead(
    rate: float, starts: int, limit: int, wishes: list[tuple[bool, int]]
) -> None:
    limiter = RateLimiter(rate, starts, limit)
    for insert_first, size in wishes:
        assert limiter.may_update() or limiter.may_insert()
        before, started = limiter.lag, limiter.transitions >= starts
        if limiter.may_insert() and (insert_first or not limiter.may_update()):
            limiter.inserted(size)
        else:
            limiter.updated()
        assert limiter.updates <= rate * limiter.transitions + 1e-6
        assert limiter.updates == 0 or limiter.transitions >= starts
        if started:  # a batch is inserted whole
            assert limiter.lag <= max(before, limit - 1 + math.ceil(rate * size))


@pytest.mark.parametrize(
    ("rate", "limit", "reason"),
    [
        (0.1, 0, "the lag must be at least 1 update, got 0"),
        *(
            (rate, 1, f"agent.updates_per_transition must be positive and finite, got {rate}: no")
            for rate in (0.0, math.nan, math.inf)
        ),
    ],
)
def test_settings_that_would_deadlock(rate: float, limit: int, reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        RateLimiter(rate, 1, limit)
    assert str(caught.value).startswith(reason)


def test_a_restore_takes_counters_but_not_the_policy() -> None:
    before = RateLimiter(10.0, 1, 4)
    before.inserted(100)
    before.updated(990)
    after = RateLimiter(0.5, 1, 4)
    after.load_state(json.loads(json.dumps(before.state())))
    # The debt of 10 stays, and new transitions count by the new rate.
    assert (after.transitions, after.updates, after.lag) == (100, 990, 10)
    after.updated(10)
    after.inserted(4)
    assert after.lag == 2
    again = RateLimiter(10.0, 1, 4)
    again.load_state(after.state())
    assert again.lag == 2


@given(st.floats(1e-3, 10), st.lists(st.integers(1, 100), max_size=20))
def test_a_round_trip_changes_nothing(rate: float, sizes: list[int]) -> None:
    plain, restored = RateLimiter(rate, 5, 3), RateLimiter(rate, 5, 3)
    for size in sizes:
        plain.inserted(size)
        restored.inserted(size)
        fresh = RateLimiter(rate, 5, 3)
        fresh.load_state(restored.state())
        restored = fresh
        assert restored.lag == plain.lag
        plain.updated(plain.lag // 2)
        restored.updated(restored.lag // 2)


@pytest.mark.parametrize(
    "state",
    [
        {},
        {"transitions": 1, "updates": 1},
        {"transitions": -1, "updates": 1, "due": 1.0},
        {"transitions": 1, "updates": 1, "due": math.nan},
    ],
)
def test_malformed_counters_are_refused(state: dict[str, float]) -> None:
    with pytest.raises(RunError, match="limiter must hold transitions, updates and due, got"):
        RateLimiter(0.1, 1, 1).load_state(state)
