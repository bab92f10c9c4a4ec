"""A process that lives but makes no progress ends itself, and leaves its stack behind.

The clock runs in a thread of C that needs no interpreter, so it also sees a process that hangs in
an extension. Whoever started the process sees it end, and starts it again.
"""

import faulthandler
import time
from typing import Self

# Winding the clock up takes a thread each time.
WIND_S = 1.0
STDERR = 2


class Watchdog:
    """Ends the process, with the stacks of all threads on stderr, when `progress` is not called."""

    def __init__(self, seconds: float) -> None:
        """Wait until it is entered.

        Args:
            seconds: without progress before the end; 0 is never.
        """
        self._seconds, self._wound_s = seconds, 0.0

    def __enter__(self) -> Self:
        self._wind()
        return self

    def __exit__(self, *_: object) -> None:
        if self._seconds:
            faulthandler.cancel_dump_traceback_later()

    def progress(self) -> None:
        """Not now; cheap, call it often."""
        if self._seconds and time.monotonic() - self._wound_s >= WIND_S:
            self._wind()

    def _wind(self) -> None:
        if self._seconds:
            self._wound_s = time.monotonic()
            faulthandler.dump_traceback_later(self._seconds, exit=True, file=STDERR)
