"""Counts of events by name; problems are logged as well, ever more rarely."""

import logging
from collections import Counter

from tangram_core.settings import CONTROL

log = logging.getLogger(__name__)


class Counters(Counter[str]):
    """Name of an event -> its count."""

    def note(self, name: str, reason: str) -> None:
        """Count a problem; log the 1st, 2nd, 4th, 8th, ... of each name.

        Args:
            name: of the counter.
            reason: text for the log; control characters are escaped, as a peer may have sent it.
        """
        reason = CONTROL.sub(lambda found: ascii(found[0])[1:-1], reason)
        self[name] += 1
        count = self[name]
        if count & (count - 1) == 0:  # a power of two: a flood must not fill the log
            fields = {"event": name, "count": count}
            log.warning("%s (number %d): %s", name, count, reason, extra=fields)
