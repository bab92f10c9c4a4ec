"""SIGINT, SIGTERM, SIGHUP, SIGUSR1: the first asks for a clean end, the second ends at once."""

import os
import signal
import sys
import time
from typing import Any, Self

from tangram_core.run.outcome import CTRL_C
from tangram_core.run.process import handling

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
# Signals this close together count as one: at a time limit, a scheduler may signal a process and
# then its whole group.
SAME_WISH_S = 1.0
SHOW_CURSOR = b"\x1b[?25h\n"


def stop_notice(name: str) -> str:
    """The line for the user when the signal of this name ends a run."""
    return f"{CTRL_C.get(name, name)}: the run ends with a checkpoint; repeat it to end at once"


class StopSignals:
    """A context manager that catches the signals.

    Attributes:
        reason: name of the first signal; None before.
    """

    def __init__(self) -> None:
        self.reason: str | None = None
        self._first_s = 0.0
        self._handling = handling(self._handle, SIGNALS)

    def __enter__(self) -> Self:
        self._handling.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._handling.__exit__(*error)

    def _handle(self, number: signal.Signals) -> None:
        if self.reason is None:
            self.reason, self._first_s = number.name, time.monotonic()
        if time.monotonic() - self._first_s < SAME_WISH_S:
            return
        show_cursor()
        os._exit(128 + number)


def show_cursor() -> None:
    """Show the cursor again if stdout is a terminal; a live panel that was killed hides it."""
    if sys.stdout.isatty():
        os.write(sys.stdout.fileno(), SHOW_CURSOR)
