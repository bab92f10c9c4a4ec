"""What a player tells its log: that it waits, and every now and then how fast it plays."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

REPORT_S = 30.0

_log = logging.getLogger(__name__)


class Report:
    """Counts between two log lines."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._begin()

    def _begin(self) -> None:
        self._since = self._clock()
        self._episodes = 0
        self._waited = 0.0
        self._told: set[str] = set()

    @contextmanager
    def waiting(self, why: str) -> Iterator[None]:
        """Time that passes inside is no play; each reason is said once between two reports."""
        if why not in self._told:
            _log.info("waits: %s", why, extra={"event": "waits"})
            self._told.add(why)
        start = self._clock()
        try:
            yield
        finally:
            self._waited += self._clock() - start

    def played(self, episodes: int, version: int) -> None:
        """Count episodes; a line when it is time."""
        self._episodes += episodes
        passed = self._clock() - self._since
        if passed < REPORT_S:
            return
        values = {
            "episodes": self._episodes,
            "seconds": passed,
            "episodes_per_s": self._episodes / passed,
            "percent_waiting": 100.0 * self._waited / passed,
            "weights_version": version,
        }
        _log.info(
            "%d episodes in %.0f s (%.1f/s), %.0f %% of the time waiting, weights %d",
            *values.values(),
            extra={"event": "played", **values},
        )
        self._begin()
