"""Signals: the first asks for a clean end, the second ends at once."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from master.signals import SIGNALS, StopSignals
from tangram_core.run.process import handling

LIMIT_S = 100.0


ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


# A process in the middle of its loop, as the master is.
SIGNALLED = """
import signal, sys
from master.signals import StopSignals
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
    signal.signal(number, signal.SIG_DFL)
with StopSignals() as stop:
    print("ready", flush=True)
    while stop.reason is None:
        signal.sigtimedwait([], 0.01)
    print(stop.reason, flush=True)
    if sys.argv[1] == "stuck":
        while True:
            signal.sigtimedwait([], 0.01)
"""


@pytest.mark.fast
def test_a_signal_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    earlier = signal.getsignal(signal.SIGTERM)
    try:
        with handling(lambda _: None, SIGNALS):
            ignored = [n for n in ENDING if signal.getsignal(n) == signal.SIG_IGN]
        assert ignored == [signal.SIGHUP]
        with StopSignals() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert stop.reason is None
            signal.raise_signal(signal.SIGTERM)
            assert stop.reason == "SIGTERM"
        assert signal.getsignal(signal.SIGTERM) == earlier
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.cluster
@pytest.mark.parametrize(
    ("number", "kind"),
    [(signal.SIGTERM, "orderly"), *((number, "stuck") for number in ENDING)],
)
def test_the_first_signal_asks_and_the_second_ends(number: signal.Signals, kind: str) -> None:
    command = [sys.executable, "-c", SIGNALLED, kind]
    environ = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    with subprocess.Popen(command, env=environ, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        assert process.stdout.readline() == f"{number.name}\n"
        # At once it would count as the same wish, sent twice.
        deadline = time.monotonic() + LIMIT_S
        while kind == "stuck" and process.poll() is None and time.monotonic() < deadline:
            process.send_signal(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.1)
        assert process.wait(LIMIT_S) == (0 if kind == "orderly" else 128 + number)
