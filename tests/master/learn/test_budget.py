"""The bounds of a run: how much of them is used, what ends learning, and the time that is left."""

from types import SimpleNamespace
from typing import Any

import pytest

from master.config import MasterConfig
from master.learn.budget import Budget, Rates
from master.record.rundir import Record

pytestmark = pytest.mark.fast


def budget(seconds: float, episodes: int, updates: int, **bounds: Any) -> Budget:
    """A budget of which so much is used."""
    trainer = SimpleNamespace(episodes=episodes, updates=updates)
    return Budget(
        MasterConfig("runs/x", **{"max_updates": 0} | bounds), trainer, Record(loop_s=seconds)
    )  # type: ignore[arg-type]


# bounds, (seconds, episodes, updates) -> share, what ends learning
USED = [
    ({}, (1e9, 10**9, 10**9), 0.0, None),
    ({"max_updates": 100}, (1e9, 10**9, 25), 0.25, None),
    ({"max_updates": 100}, (0.0, 0, 99), 0.99, None),
    ({"max_updates": 100}, (0.0, 0, 100), 1.0, "max_updates=100"),
    ({"max_updates": 100}, (0.0, 0, 101), 1.0, "max_updates=100"),
    ({"max_episodes": 100}, (0.0, 50, 0), 0.5, None),
    ({"max_hours": 0.5}, (1799.0, 0, 10**9), 1799 / 1800, None),
    ({"max_hours": 0.5}, (1800.0, 0, 0), 1.0, "max_hours=0.5"),
    ({"max_hours": 1}, (3600.0, 0, 0), 1.0, "max_hours=1"),
    ({"max_hours": 1 / 3}, (1200.0, 0, 0), 1.0, f"max_hours={1 / 3!r}"),  # resume=auto compares it
    ({"max_hours": 1, "max_updates": 100}, (900.0, 0, 10), 0.25, None),
    ({"max_hours": 1, "max_updates": 100}, (900.0, 0, 30), 0.3, None),
]


@pytest.mark.parametrize(("bounds", "used", "share", "reason"), USED)
def test_the_share_used_most_decides_and_a_bound_ends_learning(
    bounds: dict[str, Any], used: tuple[float, int, int], share: float, reason: str | None
) -> None:
    made = budget(*used, **bounds)
    assert made.share == pytest.approx(share)
    assert made.bounded == bool(bounds)
    assert made.spent() == reason
    assert made.updates_spent() == (reason == "max_updates=100")


@pytest.mark.parametrize(
    ("bound", "episodes", "takes"), [(0, 10**9, True), (10, 9, True), (10, 10, False)]
)
def test_episodes_are_taken_up_to_the_bound(bound: int, episodes: int, takes: bool) -> None:
    assert budget(0.0, episodes, 0, max_episodes=bound).takes_episodes() is takes


def test_rates_over_a_window() -> None:
    rates = Rates()
    assert (rates.transitions_per_s(), rates.updates_per_s(), rates.left_s()) == (0.0, 0.0, None)
    # Slow for 20 s, then ten times as fast: the slow part leaves the window. It learns for a fifth.
    for second in range(21):
        rates.mark(second, 100 * second, second, second / 100, second / 5)
    assert rates.transitions_per_s() == pytest.approx(100.0)
    for second in range(21, 41):
        passed = second - 20
        rates.mark(second, 2000 + 1000 * passed, 20 + 10 * passed, second / 100, second / 5)
    assert rates.transitions_per_s() == pytest.approx(1000.0)
    assert rates.updates_per_s() == pytest.approx(10.0)
    assert rates.transitions_per_busy_s() == pytest.approx(5000.0)
    assert rates.left_s() == pytest.approx(60.0)


def test_time_left_of_a_resumed_run_counts_from_its_new_start() -> None:
    rates = Rates()
    rates.mark(0.0, 0, 0, 0.5, 0.0)
    assert rates.left_s() is None
    rates.mark(10.0, 0, 0, 0.6, 0.0)
    assert rates.left_s() == pytest.approx(40.0)
