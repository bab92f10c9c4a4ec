"""SIGINT, SIGTERM, SIGHUP, SIGUSR1: the first asks for a clean end, the second ends at once."""

import os
import signal
import sys
import time
from types import FrameType, TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
# One wish to end may arrive twice: a time limit signals a process and then its whole group.
SAME_WISH_S = 1.0
SHOW_CURSOR = b"\x1b[?25h\n"


def heeded() -> list[signal.Signals]:
    """Those that are not ignored: nohup and scripts hide some from what they start."""
    return [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]


class StopSignals:
    """Catches the signals while it is entered.

    Attributes:
        reason: name of the first signal, or None.
    """

    def __init__(self) -> None:
        self.reason: str | None = None
        self._first_s = 0.0
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._handle) for number in heeded()}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        if self.reason is None:
            self.reason, self._first_s = signal.Signals(number).name, time.monotonic()
        if time.monotonic() - self._first_s < SAME_WISH_S:
            return
        show_cursor()
        os._exit(128 + number)


def show_cursor() -> None:
    """Where a live panel was killed, which had hidden it, nobody else will show it again."""
    if sys.stdout.isatty():
        os.write(sys.stdout.fileno(), SHOW_CURSOR)
