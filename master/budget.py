"""How much of a run's budget is used, and how fast it goes."""

from collections import deque

from master.config import MasterConfig

RATE_WINDOW_S = 10.0
HOUR_S = 3600.0


class Budget:
    """The bounds of a run: hours, episodes and updates; the one used most decides."""

    def __init__(self, config: MasterConfig) -> None:
        self.max_seconds = config.max_hours * HOUR_S
        self.max_episodes = config.max_episodes
        self.max_updates = config.max_updates
        self.bounded = bool(self.max_seconds or self.max_episodes or self.max_updates)

    def share(self, seconds: float, episodes: int, updates: int) -> float:
        """The largest used share, in [0, 1]; 0 where nothing is bounded."""
        pairs = (
            (seconds, self.max_seconds),
            (episodes, self.max_episodes),
            (updates, self.max_updates),
        )
        return min(max((used / bound for used, bound in pairs if bound), default=0.0), 1.0)

    def takes_episodes(self, episodes: int) -> bool:
        """Whether more episodes may enter the replay."""
        return not self.max_episodes or episodes < self.max_episodes

    def spent(self, seconds: float, updates: int) -> str | None:
        """The bound at which learning stops at once, or None."""
        if self.max_updates and updates >= self.max_updates:
            return f"max_updates={self.max_updates}"
        if self.max_seconds and seconds >= self.max_seconds:
            return f"max_hours={self.max_seconds / HOUR_S:g}"
        return None


class Rates:
    """Events per second over the last seconds, and the time left."""

    def __init__(self, window_s: float = RATE_WINDOW_S) -> None:
        self.window_s = window_s
        self._marks: deque[tuple[float, int, int, float]] = deque()
        self._first: tuple[float, float] | None = None

    def mark(self, now_s: float, transitions: int, updates: int, share: float) -> None:
        """Note the counters at a time of a steady clock."""
        if self._first is None:
            self._first = (now_s, share)
        self._marks.append((now_s, transitions, updates, share))
        while len(self._marks) > 2 and now_s - self._marks[1][0] >= self.window_s:
            self._marks.popleft()

    def transitions_per_s(self) -> float:
        """Transitions that entered the replay, per second."""
        return self._rate(1)

    def updates_per_s(self) -> float:
        """Updates per second."""
        return self._rate(2)

    def left_s(self) -> float | None:
        """Seconds until the budget is used, at the pace since the start; None when unknown."""
        if self._first is None:
            return None
        now_s, share = self._marks[-1][0], self._marks[-1][3]
        gained = share - self._first[1]
        if gained <= 0.0:
            return None
        return (now_s - self._first[0]) * (1.0 - share) / gained

    def _rate(self, column: int) -> float:
        if len(self._marks) < 2:
            return 0.0
        first, last = self._marks[0], self._marks[-1]
        return float(last[column] - first[column]) / max(last[0] - first[0], 1e-9)
