"""What the hub sends, and what it refuses: counted by name, told at a bounded rate."""

import logging
from collections import Counter

from master.keys import Keys
from master.sockets import Sockets
from tangram_agent.wire import Plain

log = logging.getLogger(__name__)


class Post:
    """Messages to peers.

    Attributes:
        sockets: open.
        counters: traffic and refusals by name.
    """

    def __init__(self, bind: str, port: int, keys: Keys | None) -> None:
        self.counters: Counter[str] = Counter()
        self.sockets = Sockets(bind, port, self.counters, keys)

    def send(self, identity: bytes, answer: Plain) -> None:
        """Send to a peer, unless it is gone or does not read."""
        self.sockets.send(identity, answer.encode())

    def refuse(self, identity: bytes, counter: str, answer: Plain) -> None:
        """Send a reason, count it and tell it."""
        self.count(counter, getattr(answer, "reason", "a connection without HELLO"))
        self.send(identity, answer)

    def count(self, counter: str, reason: str) -> None:
        """Count something that went wrong, and tell it now and then."""
        self.counters[counter] += 1
        count = self.counters[counter]
        if count & (count - 1) == 0:  # the 1st, 2nd, 4th, ...: a flood must not fill the log
            log.warning("%s (number %d): %s", counter, count, reason)
