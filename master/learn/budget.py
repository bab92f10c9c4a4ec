"""The budget of a run, and rates of progress."""

from collections import deque

from master.config import MasterConfig
from master.learn.trainer import Trainer
from master.record.rundir import Record

RATE_WINDOW_S = 10.0
HOUR_S = 3600.0


class Budget:
    """The bounds of a run: hours, episodes and updates; the run ends at the first one reached.

    Attributes:
        bounded: whether any bound is set.
    """

    def __init__(self, config: MasterConfig, trainer: Trainer, record: Record) -> None:
        self._trainer, self._record = trainer, record
        self.max_hours = float(config.max_hours)
        self.max_episodes = config.max_episodes
        self.max_updates = config.max_updates
        self.bounded = bool(self.max_hours or self.max_episodes or self.max_updates)

    @property
    def share(self) -> float:
        """The largest used share of a bound, in [0, 1]; 0 if no bound is set."""
        spent = (
            (self._record.loop_s, self.max_hours * HOUR_S),
            (self._trainer.episodes, self.max_episodes),
            (self._trainer.updates, self.max_updates),
        )
        return min(max((used / bound for used, bound in spent if bound), default=0.0), 1.0)

    def takes_episodes(self) -> bool:
        """Whether max_episodes allows more episodes."""
        return not self.max_episodes or self._trainer.episodes < self.max_episodes

    def updates_spent(self) -> bool:
        """Whether max_updates is reached."""
        return bool(self.max_updates) and self._trainer.updates >= self.max_updates

    def spent(self) -> str | None:
        """The bound that is reached and ends learning at once, as in `max_updates=9`, or None."""
        if self.updates_spent():
            return f"max_updates={self.max_updates}"
        if self.max_hours and self._record.loop_s >= self.max_hours * HOUR_S:
            return f"max_hours={repr(self.max_hours).removesuffix('.0')}"  # all digits
        return None


class Rates:
    """Rates over the last `RATE_WINDOW_S` seconds, and the time left."""

    def __init__(self) -> None:
        self._marks: deque[tuple[float, int, int, float, float]] = deque()
        self._first: tuple[float, float] | None = None

    def mark(
        self, now_s: float, transitions: int, updates: int, share: float, busy_s: float
    ) -> None:
        """Note the counters, the monotonic time `now_s` and the processor time `busy_s`."""
        if self._first is None:
            self._first = (now_s, share)
        self._marks.append((now_s, transitions, updates, share, busy_s))
        while len(self._marks) > 2 and now_s - self._marks[1][0] >= RATE_WINDOW_S:
            self._marks.popleft()

    def transitions_per_s(self) -> float:
        """Transitions inserted into the replay buffer per second."""
        return self._rate(1)

    def updates_per_s(self) -> float:
        """Updates per second."""
        return self._rate(2)

    def transitions_per_busy_s(self) -> float:
        """Transitions per second of processor time: the rate if the learner never waited."""
        return self._rate(1, of=4)

    def left_s(self) -> float | None:
        """Seconds until the budget is used, at the mean rate of this process; None if unknown."""
        if self._first is None:
            return None
        now_s, share = self._marks[-1][0], self._marks[-1][3]
        gained = share - self._first[1]
        if gained <= 0.0:
            return None
        return (now_s - self._first[0]) * (1.0 - share) / gained

    def _rate(self, column: int, of: int = 0) -> float:
        if len(self._marks) < 2:
            return 0.0
        first, last = self._marks[0], self._marks[-1]
        return float(last[column] - first[column]) / max(last[of] - first[of], 1e-9)
