"""A ring buffer over preallocated arrays, the base of all replay buffers."""

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
        low, high: bounds of its numbers; a checkpoint beyond them is refused.
    """

    array: Array
    low: float = -_FINITE
    high: float = _FINITE


class Ring:
    """A ring buffer of rows in several columns; rows are drawn uniformly with replacement.

    Attributes:
        arrays: the columns, by name.
        capacity: most rows kept.
        added: rows ever added; the next one goes to slot `added % capacity`.
    """

    def __init__(self, columns: Mapping[str, Column], counter: str = "added") -> None:
        """Take columns with room for all rows; `counter` names the counter in a state."""
        self.arrays = {name: column.array for name, column in columns.items()}
        self.capacity, self.added = min(map(len, self.arrays.values())), 0
        self._lost = 0  # rows in `added` that a loaded state did not bring
        self._columns, self._counter = columns, counter

    def __len__(self) -> int:
        return min(self.added - self._lost, self.capacity)

    def _slots(self) -> Ints:
        """Slots of the kept rows, the oldest first."""
        kept = len(self)
        return (self.added - kept + np.arange(kept)) % self.capacity

    def append(self, rows: Mapping[str, Array]) -> Ints:
        """Append rows to all columns and drop the oldest; returns the slots of the new rows."""
        count = min(len(rows[name]) for name in self.arrays)
        kept = min(count, self.capacity)
        slots = (self.added + count - kept + np.arange(kept)) % self.capacity
        for name, array in self.arrays.items():
            array[slots] = rows[name][count - kept :]
        self.added += count
        return slots

    def drawn(self, size: int, generator: np.random.Generator) -> Ints:
        """Slots of `size` rows, drawn uniformly with replacement.

        Raises:
            ValueError: the buffer is empty.
        """
        if not len(self):
            raise ValueError("cannot sample from an empty replay")
        oldest = self.added - len(self)
        return (oldest + generator.integers(len(self), size=size)) % self.capacity

    def state(self) -> dict[str, Array]:
        """The kept rows (mostly views) and the counter.

        The n-th row since the start has the index n modulo the number of kept rows.
        """
        kept = len(self)
        rows: slice | Ints = slice(kept)
        if kept < self.capacity and self._lost:  # loaded from a full ring with less room
            rows = np.roll(self._slots(), self.added % kept)
        arrays = {name: array[rows] for name, array in self.arrays.items()}
        return arrays | {self._counter: np.array([self.added], np.int64)}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Load a state; if it has too many rows, only the newest.

        Raises:
            RunError: columns are missing, have another shape or type, or exceed their bounds.
        """
        self.check_valid(state)
        added, kept = int(state[self._counter][0]), len(state[next(iter(self.arrays))])
        order = np.roll(np.arange(kept), -(added % kept) if kept else 0)[-self.capacity :]
        self.added, self._lost = added, added - len(order)
        slots = self._slots()
        for name, array in self.arrays.items():
            array[slots] = state[name][order]

    def check_valid(self, found: Mapping[str, Array]) -> None:
        """Raise RunError if columns of a state have wrong shapes or numbers."""
        added = int(found[self._counter][0]) if self._counter in found else -1
        kept = len(found.get(next(iter(self.arrays)), ()))
        for name, column in self._columns.items():
            part, wanted = found.get(name), column.array
            if (
                part is None
                or part.shape != (kept, *wanted.shape[1:])
                or part.dtype != wanted.dtype
                or added < kept
                or not ((column.low <= part) & (part <= column.high)).all()  # NaN fails, too
            ):
                raise RunError(
                    f"replay state: '{name}' must be {wanted.dtype} {(kept, *wanted.shape[1:])} "
                    f"within {column.low:g} and {column.high:g}: it belongs to another "
                    "task or version, or is damaged: start a new run"
                )
