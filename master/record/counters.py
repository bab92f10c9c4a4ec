"""Counts of what goes on, by name; what goes wrong is told now and then."""

import logging
from collections import Counter

from tangram_core.settings import CONTROL

log = logging.getLogger(__name__)


class Counters(Counter[str]):
    """Name -> count."""

    def note(self, name: str, reason: str) -> None:
        """Count something that went wrong, and tell it now and then.

        Args:
            name: of the count.
            reason: may hold what a peer sent: control characters are told as what they are.
        """
        reason = CONTROL.sub(lambda found: ascii(found[0])[1:-1], reason)
        self[name] += 1
        count = self[name]
        if count & (count - 1) == 0:  # the 1st, 2nd, 4th, ...: a flood must not fill the log
            fields = {"event": name, "count": count}
            log.warning("%s (number %d): %s", name, count, reason, extra=fields)
