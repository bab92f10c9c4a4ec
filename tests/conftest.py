"""Rules that hold for every test."""

import signal

import pytest
import torch

# The sizes are small: a second thread costs more than it brings, the more so on a busy machine.
torch.set_num_threads(1)

# nohup and some runners have it ignored, which the commands under test would inherit and respect.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

TIERS = ("fast", "cluster", "slow", "slurm")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse a test without its tier: it would run nowhere or everywhere, by accident."""
    for item in items:
        tiers = [name for name in TIERS if item.get_closest_marker(name)]
        if len(tiers) != 1:
            raise pytest.UsageError(
                f"{item.nodeid} must carry exactly one of the markers {', '.join(TIERS)}, "
                f"has {', '.join(tiers) or 'none'}"
            )
