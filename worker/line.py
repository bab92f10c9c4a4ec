"""The connection to the master: found, opened, and made anew when it is silent or takes no keys."""

import logging
import math
from collections import Counter

import zmq

from tangram_sim.errors import RunError, TangramError
from worker.channel import LINGER_MS, Channel
from worker.connection import Connection, estranged, find_connection
from worker.terms import Timing

log = logging.getLogger(__name__)


class Line:
    """One connection at a time; the next one may have another address.

    Attributes:
        channel: the present connection's sockets, None before the address is known.
        found: where they lead.
        stranger: the last handshake failed, because keys do not fit.
    """

    def __init__(self, connect: str, timing: Timing, counters: Counter[str]) -> None:
        self.channel: Channel | None = None
        self.found: Connection | None = None
        self.stranger = False
        self._connect, self._timing, self._counters = connect, timing, counters
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        # Since when an answer is due on this connection, and on all since the last answer.
        self._asked_at: float | None = None
        self._lost_at: float | None = None
        self._reopen_at, self._follow_at = math.inf, 0.0

    @property
    def place(self) -> str:
        """Where the master is, as far as known."""
        return self.found.endpoint if self.found else self._connect

    @property
    def estranged(self) -> str:
        """Why a handshake fails."""
        return estranged(self._connect, self.place)

    @property
    def is_waiting(self) -> bool:
        """Whether no answer has come since the connection before this one was given up."""
        return self._lost_at is not None

    def open(self) -> bool:
        """Connect to where the master is now; False while that is not known."""
        self.found = find_connection(self._connect)
        if self.found is None:
            return False
        self.channel = Channel(self._context, self.found)
        return True

    def drop(self) -> None:
        """Close a connection that leads nowhere."""
        self._counters["reconnects"] += 1
        if self._lost_at is None:
            self._lost_at = self._asked_at
        self._asked_at, self._reopen_at = None, math.inf
        if self.channel is not None:
            self.channel.close()
            self.channel = None

    def asked(self, now: float) -> None:
        """A question was sent."""
        if self._asked_at is None:
            self._asked_at = now

    def answered(self) -> None:
        """Anything came."""
        if self._lost_at is not None:
            log.info("the master at %s answers again", self.place, extra={"event": "found_again"})
        self._asked_at = self._lost_at = None

    def look(self, now: float) -> None:
        """Note a master that moved, and a handshake that failed: its file may change, too."""
        self._follow(now)
        if self.channel is None or not self.channel.handshake_failed():
            return
        self._counters["handshakes_failed"] += 1
        if not self.stranger:
            log.warning("%s", self.estranged, extra={"event": "estranged"})
        self.stranger, self._reopen_at = True, now + self._timing.retry_s

    def is_dead(self, now: float) -> bool:
        """Whether to try another connection."""
        silent = self._asked_at is not None and now - self._asked_at > self._timing.silence_s
        if silent and self._lost_at is None and not self.stranger:
            log.warning(
                "the master at %s has not answered for %g s: tries again for %g s",
                self.place,
                self._timing.silence_s,
                self._timing.lost_s,
                extra={"event": "silent"},
            )
        return silent or now >= self._reopen_at

    def _follow(self, now: float) -> None:
        """A master that was started again writes its new address into the same file."""
        if now < self._follow_at:
            return
        self._follow_at = now + self._timing.retry_s
        try:
            found = find_connection(self._connect)
        except RunError:
            return  # by the next look it may be whole
        if found is not None and found != self.found:
            log.info("the master is at %s now", found.endpoint, extra={"event": "moved"})
            self._reopen_at = now

    def check_lost(self, now: float) -> None:
        """Raise TangramError if no connection brought an answer for too long."""
        if self._lost_at is not None and now - self._lost_at > self._timing.lost_s:
            raise TangramError(
                f"the master at {self.place} has not answered for {self._timing.lost_s:g} s: "
                "is it still running?"
            )

    def close(self) -> None:
        """Close; what is queued gets a second."""
        if self.channel is not None:
            self.channel.close(LINGER_MS)
            self.channel = None
        self._context.destroy(linger=LINGER_MS)
