"""Rules that hold for every test."""

import os
import signal
import sys
from collections.abc import Generator

import hypothesis
import pytest
import torch

# The sizes are small: a second thread costs more than it brings, the more so on a busy machine.
torch.set_num_threads(1)

# Where compiled modules are not kept, each of the hundreds of processes compiles them anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# nohup and some runners have it ignored, which the commands under test would inherit and respect.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No test is a clock: on a busy machine an example that takes 5 ms may take 300.
hypothesis.settings.register_profile(
    "gate", deadline=None, max_examples=40, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("gate")

TIERS = ("fast", "cluster", "slow")

# Fixtures that take many seconds and are made once for all tests that look at what they made.
SHARED = ("trained",)

# The longest come first, so that no worker of xdist is left with one of them at the end. Seconds
# on two cores with other work beside them. Groups come before these, the largest first.
SECONDS = {
    "test_lockstep.py::test_the_same_numbers_come_twice": 80,
    "test_experiments.py::test_a_study_is_stopped": 60,
    "test_training.py::test_a_run_begins_with_anothers_networks": 30,
    "test_delivery.py::test_acknowledged_batches_survive": 27,
    "test_faults.py::test_a_network_that_swallows": 19,
    "test_faults.py::test_who_is_frozen": 14,
    "test_faults.py::test_no_process_is_left": 10,
    "test_compiling.py": 8,
    "test_agents.py::test_an_agent_of_the_package": 7,
    "test_history.py": 6,
    "test_player.py": 5,
}

NO_BROWSER = "no chromium"  # begins the reason of those that are skipped


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Refuse a test without its tier: it would run nowhere or everywhere, by accident.

    Tests that share a fixture go to one worker of --dist=loadgroup, all others wherever one is
    free, the longest first. What is marked `check` runs only where -m names it, whatever else is
    asked for.
    """
    for item in items:
        for name in SHARED:
            if name in getattr(item, "fixturenames", ()):
                item.add_marker(pytest.mark.xdist_group(name))
        tiers = [name for name in TIERS if item.get_closest_marker(name)]
        if len(tiers) != 1:
            raise pytest.UsageError(
                f"{item.nodeid} must carry exactly one of the markers {', '.join(TIERS)}, "
                f"has {', '.join(tiers) or 'none'}"
            )
    if "check" not in config.option.markexpr:
        config.hook.pytest_deselected(items=[item for item in items if is_long(item)])
        items[:] = [item for item in items if not is_long(item)]
    items.sort(key=seconds, reverse=True)


def seconds(item: pytest.Item) -> int:
    """From the table."""
    return next((taken for name, taken in SECONDS.items() if name in item.nodeid), 0)


def is_long(item: pytest.Item) -> bool:
    """Whether it is left to make check."""
    return bool(item.get_closest_marker("check"))


@pytest.hookimpl(wrapper=True, tryfirst=True)  # so that it is the last line but one
def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter,
) -> Generator[None, None, None]:
    """Tell in a line of its own that nothing ran in a browser: among dots nobody would notice."""
    yield
    skipped = terminalreporter.stats.get("skipped", [])
    count = sum(NO_BROWSER in str(report.longrepr) for report in skipped)
    if count:
        line = f"NOT RUN: {count} tests in a browser. Install it: sudo apt-get install chromium"
        terminalreporter.write_line(line, yellow=True, bold=True)
