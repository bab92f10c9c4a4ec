"""Wrong settings are refused with the value, the bound and the remedy; budgets and rates."""

from typing import Any

import pytest

from master.budget import Budget, Rates
from master.config import LaunchConfig, MasterConfig
from tangram_agent.config import ServiceConfig
from tangram_agent.setup import from_mapping
from tangram_sim.errors import ConfigError

pytestmark = pytest.mark.fast


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"run_dir": " "}, "run_dir must name a folder, got '': set run_dir=runs/my_run"),
        ({"seed": -1}, "seed must be between 0 and"),
        ({"max_hours": -0.5}, "max_hours must be at least 0, got -0.5"),
        ({"max_hours": float("nan")}, "max_hours must be at least 0, got nan"),
        ({"max_episodes": -1}, "max_episodes must be at least 0, got -1"),
        ({"max_updates": -1}, "max_updates must be at least 0, got -1"),
        ({"resume": "maybe"}, "resume must be one of none, auto, got 'maybe'"),
    ],
)
def test_a_wrong_master_is_refused(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        MasterConfig(**{"run_dir": "runs/x"} | settings)


@pytest.mark.parametrize(
    ("workers", "reason"),
    [
        (0, "workers must be at least 1, got 0: without one nothing is played"),
        (-2, "workers must be at least 1, got -2"),
        (1025, "workers must be between 1 and 1024, got 1025"),
    ],
)
def test_wrong_numbers_of_workers_are_refused(workers: int, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        LaunchConfig(MasterConfig("runs/x"), workers)


def test_settings_come_from_a_plain_mapping() -> None:
    master = {"run_dir": "runs/x", "max_hours": 2, "service": {"port": 5555}}
    config = from_mapping(LaunchConfig, {"workers": 2, "master": master})
    expected = MasterConfig("runs/x", max_hours=2.0, service=ServiceConfig(port=5555))
    assert config == LaunchConfig(expected, 2)


def budget(**bounds: Any) -> Budget:
    return Budget(MasterConfig("runs/x", **{"max_updates": 0} | bounds))


SHARES = [
    ({}, (1e9, 10**9, 10**9), 0.0),
    ({"max_updates": 100}, (1e9, 10**9, 25), 0.25),
    ({"max_episodes": 100}, (0.0, 50, 0), 0.5),
    ({"max_hours": 1}, (900.0, 0, 0), 0.25),
    ({"max_hours": 1, "max_updates": 100}, (900.0, 0, 10), 0.25),
    ({"max_hours": 1, "max_updates": 100}, (900.0, 0, 30), 0.3),
    ({"max_updates": 100}, (0.0, 0, 101), 1.0),
]


@pytest.mark.parametrize(("bounds", "used", "share"), SHARES)
def test_the_share_used_most_decides(
    bounds: dict[str, Any], used: tuple[float, int, int], share: float
) -> None:
    assert budget(**bounds).share(*used) == pytest.approx(share)
    assert budget(**bounds).bounded == bool(bounds)


@pytest.mark.parametrize(
    ("bounds", "seconds", "updates", "reason"),
    [
        ({}, 1e9, 10**9, None),
        ({"max_updates": 10}, 1e9, 9, None),
        ({"max_updates": 10}, 0.0, 10, "max_updates=10"),
        ({"max_hours": 0.5}, 1799.0, 10**9, None),
        ({"max_hours": 0.5}, 1800.0, 0, "max_hours=0.5"),
    ],
)
def test_what_ends_learning(
    bounds: dict[str, Any], seconds: float, updates: int, reason: str | None
) -> None:
    assert budget(**bounds).spent(seconds, updates) == reason


@pytest.mark.parametrize(
    ("bound", "episodes", "takes"), [(0, 10**9, True), (10, 9, True), (10, 10, False)]
)
def test_episodes_are_taken_up_to_the_bound(bound: int, episodes: int, takes: bool) -> None:
    assert budget(max_episodes=bound).takes_episodes(episodes) is takes


def test_rates_over_a_window() -> None:
    rates = Rates(window_s=10.0)
    assert (rates.transitions_per_s(), rates.updates_per_s(), rates.left_s()) == (0.0, 0.0, None)
    # Slow for 20 s, then ten times as fast: the slow part leaves the window.
    for second in range(21):
        rates.mark(second, 100 * second, second, second / 100)
    assert rates.transitions_per_s() == pytest.approx(100.0)
    for second in range(21, 41):
        rates.mark(second, 2000 + 1000 * (second - 20), 20 + 10 * (second - 20), second / 100)
    assert rates.transitions_per_s() == pytest.approx(1000.0)
    assert rates.updates_per_s() == pytest.approx(10.0)
    assert rates.left_s() == pytest.approx(60.0)


def test_time_left_of_a_resumed_run_counts_from_its_new_start() -> None:
    rates = Rates()
    rates.mark(0.0, 0, 0, 0.5)
    assert rates.left_s() is None
    rates.mark(10.0, 0, 0, 0.6)
    assert rates.left_s() == pytest.approx(40.0)
