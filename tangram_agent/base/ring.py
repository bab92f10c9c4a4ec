"""What replays are made of: a ring over preallocated arrays."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tangram_core.arrays import Ints
from tangram_core.errors import RunError
from tangram_core.spec import Array

_FINITE = float(np.finfo(np.float32).max)


@dataclass(frozen=True, eq=False)
class Column:
    """One array of a ring.

    Attributes:
        array: (capacity, ...) with room for all rows.
        low, high: bounds of its numbers, which a checkpoint must keep.
    """

    array: Array
    low: float = -_FINITE
    high: float = _FINITE


class Ring:
    """Keeps the newest rows of some columns; rows are drawn uniformly with replacement.

    Attributes:
        arrays: the columns, by name.
        capacity: rows kept.
        added: rows ever added; the next one goes to slot `added % capacity`.
    """

    def __init__(self, columns: Mapping[str, Column], counter: str = "added") -> None:
        """Take columns with room for all rows, and the name that a state has the counter by."""
        self.arrays = {name: column.array for name, column in columns.items()}
        self.capacity, self.added = min(map(len, self.arrays.values())), 0
        self._lost = 0  # rows that were added and not taken over with a state
        self._columns, self._counter = columns, counter

    def __len__(self) -> int:
        return min(self.added - self._lost, self.capacity)

    def _slots(self) -> Ints:
        """Where the kept rows lie, the oldest first."""
        kept = len(self)
        return (self.added - kept + np.arange(kept)) % self.capacity

    def append(self, rows: Mapping[str, Array]) -> Ints:
        """Add rows to all columns; the oldest make room. Where those lie that are kept."""
        count = min(len(rows[name]) for name in self.arrays)
        kept = min(count, self.capacity)
        slots = (self.added + count - kept + np.arange(kept)) % self.capacity
        for name, array in self.arrays.items():
            array[slots] = rows[name][count - kept :]
        self.added += count
        return slots

    def drawn(self, size: int, generator: np.random.Generator) -> Ints:
        """Where `size` rows lie.

        Raises:
            ValueError: there are none.
        """
        if not len(self):
            raise ValueError("cannot sample from an empty replay")
        oldest = self.added - len(self)
        return (oldest + generator.integers(len(self), size=size)) % self.capacity

    def state(self) -> dict[str, Array]:
        """The kept rows (mostly views) and the counter.

        Row n that was ever added lies at n modulo the number of those kept.
        """
        kept = len(self)
        rows: slice | Ints = slice(kept)
        if kept < self.capacity and self._lost:  # a full ring that was given more room
            rows = np.roll(self._slots(), self.added % kept)
        arrays = {name: array[rows] for name, array in self.arrays.items()}
        return arrays | {self._counter: np.array([self.added], np.int64)}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state; of more rows than there is room for, the newest.

        Raises:
            RunError: columns are missing, of another shape or type, or beyond their bounds.
        """
        self.check_valid(state)
        added, kept = int(state[self._counter][0]), len(state[next(iter(self.arrays))])
        order = np.roll(np.arange(kept), -(added % kept) if kept else 0)[-self.capacity :]
        self.added, self._lost = added, added - len(order)
        slots = self._slots()
        for name, array in self.arrays.items():
            array[slots] = state[name][order]

    def check_valid(self, state: Mapping[str, Array] | None = None) -> None:
        """Raise RunError unless all is as it can be in this ring, or in a state of it."""
        found = self.state() if state is None else state
        added = int(found[self._counter][0]) if self._counter in found else -1
        kept = len(found.get(next(iter(self.arrays)), ()))
        for name, column in self._columns.items():
            part, wanted = found.get(name), column.array
            if (
                part is None
                or part.shape != (kept, *wanted.shape[1:])
                or part.dtype != wanted.dtype
                or added < kept
                or not ((column.low <= part) & (part <= column.high)).all()  # nor is a NaN
            ):
                raise RunError(
                    f"replay state: '{name}' must be {wanted.dtype} {(kept, *wanted.shape[1:])} "
                    f"within {column.low:g} and {column.high:g}: it is of another "
                    "task or another version, or damaged: start a new run"
                )
