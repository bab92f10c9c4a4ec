"""Rules that hold for every test."""

import pytest

TIERS = ("fast", "cluster", "slow")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse a test without its tier: it would run nowhere or everywhere, by accident."""
    for item in items:
        tiers = [name for name in TIERS if item.get_closest_marker(name)]
        if len(tiers) != 1:
            raise pytest.UsageError(
                f"{item.nodeid} must carry exactly one of the markers {', '.join(TIERS)}, "
                f"has {', '.join(tiers) or 'none'}"
            )
