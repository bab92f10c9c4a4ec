"""The watchdog, in a process that hangs."""

import subprocess
import sys
import time

import pytest

from tangram_agent.process import Watchdog

pytestmark = pytest.mark.cluster

HANGS = """
import time, threading
from tangram_agent.process import Watchdog
def hang_here():
    {hang}
with Watchdog({seconds}) as dog:
    for _ in range({steps}):
        dog._wound_s = 0.0  # each call counts
        dog.progress()
        time.sleep(0.1)
    if {hangs}:
        hang_here()
print("left in order")
"""


def run(hang: str = "time.sleep(60)", seconds: float = 0.5, steps: int = 10, hangs: bool = True):
    code = HANGS.format(hang=hang, seconds=seconds, steps=steps, hangs=hangs)
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False
    )


@pytest.mark.parametrize(
    "hang",
    [
        "time.sleep(60)",
        "threading.Lock().acquire() and threading.Event().wait()",
        # Holds the interpreter in C, where no Python thread would ever get its turn.
        "import re; re.match('(a+)+$', 'a' * 40 + 'b')",
    ],
)
def test_a_process_that_hangs_ends_with_its_stack(hang: str) -> None:
    """It made progress for twice as long as the watchdog waits."""
    done = run(hang)
    assert done.returncode == 1
    assert "Timeout (0:00:00.5" in done.stderr
    assert "in hang_here" in done.stderr
    assert "left in order" not in done.stdout


@pytest.mark.parametrize(("seconds", "steps"), [(0.5, 10), (0.0, 1)])
def test_progress_and_a_watchdog_that_is_off_end_nothing(seconds: float, steps: int) -> None:
    done = run(seconds=seconds, steps=steps, hangs=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "left in order\n", "")


def test_it_is_off_after_it_was_left() -> None:
    with Watchdog(0.2) as dog:
        dog.progress()
    time.sleep(0.4)  # this process would be gone
