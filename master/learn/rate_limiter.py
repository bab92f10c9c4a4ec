"""The rate limiter: keeps the ratio of updates to transitions, for learner and players."""

import math
from collections.abc import Mapping

from tangram_core.errors import ConfigError, RunError

# Workers must wait if the learner lags by this many updates, which is some seconds of learning.
LAG_UPDATES = 64
# Products such as 0.29 * 100 are slightly below the exact integer.
ROUNDING = 1e-6


class RateLimiter:
    """The rate limiter between inserts into the replay and updates of the networks.

    With n transitions inserted, m updates done, u = updates_per_transition, s = learning_starts
    and L = lag_updates:

        due(n)     = floor(u n) if n >= s else 0
        lag        = max(0, due(n) - m)
        may_update = lag >= 1          the learner never runs ahead of u updates per transition
        may_insert = lag < L           players wait while the learner is L or more updates behind

    Boundary cases: no update is due before s transitions; with transition s, u s updates are due. A
    batch is inserted as a whole, so the lag may exceed L by u times the transitions of one batch.

    There is no deadlock: if no insert is allowed, the lag is at least L >= 1, so an update is
    allowed. With L < 1 no insert would ever be allowed, so such an L is refused.

    After a restore, u, s and L come from the settings; n, m and due(n) come from the checkpoint. A
    changed u applies to later transitions only; due(n) up to then stays as it was.

    Attributes:
        transitions: n.
        updates: m.
    """

    def __init__(
        self, updates_per_transition: float, learning_starts: int, lag_updates: int = LAG_UPDATES
    ) -> None:
        if not (math.isfinite(updates_per_transition) and updates_per_transition > 0):
            raise ConfigError(
                "agent.updates_per_transition must be positive and finite, got "
                f"{updates_per_transition}: no update would ever be made"
            )
        if lag_updates < 1:  # learner and workers would wait for each other for ever
            raise ConfigError(f"the lag must be at least 1 update, got {lag_updates}")
        self._rate, self._starts, self._limit = updates_per_transition, learning_starts, lag_updates
        self.transitions = 0
        self.updates = 0
        self._base_transitions = 0
        self._base_due = 0.0

    @property
    def lag(self) -> int:
        """Updates that are due and not done."""
        if self.transitions < self._starts:
            return 0
        return max(0, math.floor(self._due() + ROUNDING) - self.updates)

    def may_update(self) -> bool:
        """Whether an update is due."""
        return self.lag >= 1

    def may_insert(self) -> bool:
        """Whether another batch may be inserted: the lag must be below the limit."""
        return self.lag < self._limit

    def inserted(self, transitions: int) -> None:
        """Count transitions inserted into the replay buffer; relabelled ones do not count."""
        self.transitions += transitions

    def updated(self, count: int = 1) -> None:
        """Count updates; a negative count is for updates that were undone."""
        self.updates += count

    def state(self) -> dict[str, float]:
        """Counters for a checkpoint."""
        return {"transitions": self.transitions, "updates": self.updates, "due": self._due()}

    def load_state(self, state: Mapping[str, float]) -> None:
        """Load the counters of a checkpoint; RunError if one is missing, negative or not finite."""
        values = [state.get(name, -1.0) for name in ("transitions", "updates", "due")]
        if not all(math.isfinite(value) and value >= 0 for value in values):
            raise RunError(
                "the checkpoint's rate limiter must hold transitions, updates and due, got "
                f"{dict(state)}"
            )
        self.transitions, self.updates = int(values[0]), int(values[1])
        self._base_transitions, self._base_due = self.transitions, values[2]

    def _due(self) -> float:
        return self._base_due + self._rate * (self.transitions - self._base_transitions)
