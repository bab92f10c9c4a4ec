"""Intervals of the loop."""

import time


class Every:
    """True at most once in an interval."""

    def __init__(self, seconds: float, at_once: bool = False) -> None:
        self._seconds = seconds
        self._next_s = 0.0 if at_once else time.monotonic() + seconds

    def due(self) -> bool:
        """Whether the interval has passed; starts the next one if so."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + self._seconds
        return True
