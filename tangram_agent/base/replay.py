"""The replay buffer: a ring over preallocated arrays."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from tangram_agent.base.types import Transitions
from tangram_core.arrays import Ints, Singles
from tangram_core.errors import RunError
from tangram_tasks.played import Past

Array = npt.NDArray[Any]
_COUNTERS = "counters"


class ReplayBuffer:
    """Keeps the newest `capacity` transitions; sampling is uniform with replacement.

    Attributes:
        capacity: transitions kept.
        added: transitions ever added; the next one goes to slot `added % capacity`.
    """

    def __init__(
        self,
        capacity: int,
        corners: int,
        tokens: int,
        action_size: int,
    ) -> None:
        """Allocate everything at once.

        Args:
            capacity: transitions kept.
            corners: V.
            tokens: K.
            action_size: A.
        """
        self.capacity, self.added = capacity, 0
        self._first = 0  # number of the first row that was ever kept here
        points, flags = (capacity, corners, 2), (capacity, tokens)
        self._columns: dict[str, Array] = {
            "state": np.zeros(points, np.float32),
            "placed": np.zeros(flags, np.uint8),
            "action": np.zeros((capacity, action_size), np.float32),
            "reward": np.zeros(capacity, np.float32),
            "next_state": np.zeros(points, np.float32),
            "next_placed": np.zeros(flags, np.uint8),
            "done": np.zeros(capacity, np.uint8),
            "goal": np.zeros(points, np.float32),
        }

    def __len__(self) -> int:
        return min(self.added - self._first, self.capacity)

    def _slots(self) -> Ints:
        """Where the kept rows lie, the oldest first."""
        kept = len(self)
        return (self.added - kept + np.arange(kept)) % self.capacity

    def _rows(self) -> slice | Ints:
        """Where they lie, row n that was ever added at n modulo the number of those kept."""
        kept = len(self)
        if kept < self.capacity and self._first:  # a full ring that was given more room
            return np.roll(self._slots(), self.added % kept)
        return slice(kept)

    def add(self, batch: Transitions) -> None:
        """Append a batch; the oldest transitions make room."""
        kept = min(batch.count, self.capacity)
        first = self.added + batch.count - kept
        slots = (first + np.arange(kept)) % self.capacity
        for name, column in self._columns.items():
            column[slots] = getattr(batch, name)[batch.count - kept :]
        self.added += batch.count

    def sample(self, size: int, generator: np.random.Generator) -> Transitions:
        """`size` transitions, drawn uniformly with replacement.

        Raises:
            ValueError: the buffer is empty.
        """
        if not len(self):
            raise ValueError("cannot sample from an empty replay buffer")
        oldest = self.added - len(self)
        rows = (oldest + generator.integers(len(self), size=size)) % self.capacity
        return Transitions(**{name: column[rows] for name, column in self._columns.items()})

    def sample_episodes(
        self, count: int, steps: int, generator: np.random.Generator
    ) -> tuple[Past, Singles]:
        """Episodes of so many steps, drawn uniformly with replacement: their past and their ends.

        Raises:
            ValueError: none is whole.
        """
        # Rows are added episode by episode, so each begins at a multiple of its steps.
        first, end = -(-(self.added - len(self)) // steps), self.added // steps
        if first >= end:
            raise ValueError(f"the replay buffer holds no whole episode of {steps} steps")
        begin = generator.integers(first, end, size=count) * steps
        rows = (begin[:, None] + np.arange(steps)) % self.capacity
        state, action, following = (
            self._columns[name] for name in ("state", "action", "next_state")
        )
        past = Past(state[rows].astype(np.float32), action[rows].astype(np.float32))
        return past, following[rows[:, -1]].astype(np.float32)

    def check_valid(self) -> None:
        """Raise RunError unless every kept number is finite and every flag is 0 or 1."""
        rows = self._rows()
        for name, column in self._columns.items():
            part = column[rows]
            if part.dtype == np.uint8:
                if not np.isin(part, (0, 1)).all():
                    raise RunError(f"replay buffer: '{name}' holds flags other than 0 and 1")
            elif not np.isfinite(part).all():
                raise RunError(f"replay buffer: '{name}' holds numbers that are not finite")

    def state(self) -> dict[str, Array]:
        """The kept transitions and the counter, as arrays for a checkpoint (mostly views).

        Row n that was ever added lies at n modulo the number of those kept.
        """
        rows = self._rows()
        columns = {name: column[rows] for name, column in self._columns.items()}
        return columns | {_COUNTERS: np.array([self.added], np.int64)}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state from `state()`.

        A buffer of another capacity keeps the newest transitions that fit.

        Raises:
            RunError: columns are missing, or of another layout or type.
        """
        added = int(state[_COUNTERS][0]) if _COUNTERS in state else -1
        kept = len(state.get("reward", ()))
        for name, column in self._columns.items():
            part = state.get(name)
            shape = (kept, *column.shape[1:])
            if part is None or part.shape != shape or part.dtype != column.dtype or added < kept:
                raise RunError(
                    f"replay state: '{name}' does not fit the layout (expected {column.dtype} "
                    f"{shape}): was the checkpoint written with other tokens, or by another "
                    "version? Then start a new run"
                )
        # Oldest first: the state's own ring was full if it held fewer than were ever added.
        order = np.roll(np.arange(kept), -(added % kept) if added > kept else 0)[-self.capacity :]
        self.added, self._first = added, added - len(order)
        slots = self._slots()
        for name, column in self._columns.items():
            column[slots] = state[name][order]
        self.check_valid()
