"""Network inputs: a task's fields as normalised rows of numbers.

Legend: B rows, E episodes, T steps of an episode, F entries of a row.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tangram_core.arrays import Floats, Singles
from tangram_core.errors import ConfigError, RunError
from tangram_core.spec import Array, Arrays, Episodes, EpisodeSpec

FURTHEST = 5.0  # bound of a normalised entry, in standard deviations
LEAST = 1e-2  # least standard deviation: below it an entry counts as constant


class Inputs:
    """The fields that make up a row: those of each moment, then those of the episode.

    Attributes:
        size: F, entries of a row.
        names: names of these fields, in order.
    """

    def __init__(self, spec: EpisodeSpec) -> None:
        """Take all observed fields of a spec, which must pass `check`."""
        fields = sorted(spec.fields, key=lambda field: field.per == "episode")
        self._spec, self._fields = spec, [field for field in fields if field.per != "step"]
        self.names = tuple(field.name for field in self._fields)
        self.size = sum(int(np.prod(field.shape)) for field in self._fields)

    @staticmethod
    def check(spec: EpisodeSpec) -> None:
        """Raise ConfigError for a field that is not of float numbers."""
        for field in spec.fields:
            if field.dtype != "f4":
                raise ConfigError(
                    f"this agent needs fields of float numbers (f4), but {field.name} of this task "
                    f"is {field.dtype}: leave agent= out to use the task's own agent, or declare "
                    "the field of your own task as f4"
                )

    def rows(self, seen: Arrays) -> Singles:
        """Rows (B, F) of fields with B rows each."""
        count = len(seen[self._spec.achieved])
        parts = [seen[name].reshape(count, -1) for name in self.names]
        return np.concatenate(parts, axis=1, dtype=np.float32)

    def of_episodes(self, episodes: Episodes) -> Singles:
        """Rows (2 * E * (T + 1), F) of all moments, with the desired and with the achieved goal.

        Hindsight replaces the former by the latter, so the statistics count both alike.
        """
        moments, spec = episodes.steps + 1, self._spec
        seen = {
            field.name: episodes[field.name].reshape(-1, *field.shape)
            if field.per == "moment"
            else np.repeat(episodes[field.name], moments, axis=0)
            for field in self._fields
        }
        own = seen | {spec.desired: seen[spec.achieved]}
        return np.concatenate([self.rows(seen), self.rows(own)])


class Normaliser:
    """Running mean and standard deviation of each entry (Chan et al. 1979), in double precision.

    Attributes:
        size: F, entries of a row.
        mean, scale: (F,) float32 arguments of `normalised`, in workers and in the master.
    """

    def __init__(self, size: int) -> None:
        self.size, self._count = size, 0.0
        self._mean, self._squares = np.zeros(size), np.zeros(size)
        self._settle()

    def add(self, rows: Array) -> None:
        """Update the statistics by rows (B, F)."""
        count, mean = len(rows), rows.mean(axis=0, dtype=np.float64)
        squares = np.square(rows - mean).sum(axis=0)
        whole, apart = self._count + count, mean - self._mean
        self._squares += squares + apart**2 * (self._count * count / whole)
        self._mean += apart * (count / whole)
        self._count = whole
        self._settle()

    def state(self) -> dict[str, Array]:
        """The statistics, for a checkpoint."""
        return {
            "count": np.array([self._count]),
            "mean": self._mean.copy(),
            "squares": self._squares.copy(),
        }

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Load statistics from a checkpoint.

        Raises:
            RunError: they belong to another task, or are not finite.
        """
        wanted = {"count": (1,), "mean": (self.size,), "squares": (self.size,)}
        for name, shape in wanted.items():
            if (
                name not in state
                or state[name].shape != shape
                or not np.isfinite(state[name]).all()
            ):
                raise RunError(
                    f"normaliser state: '{name}' must be {shape} finite numbers: it belongs to "
                    "another task, or is damaged: take another checkpoint"
                )
        self._count = float(state["count"][0])
        self._mean = np.array(state["mean"], np.float64)
        self._squares = np.array(state["squares"], np.float64)
        self._settle()

    def _settle(self) -> None:
        deviation: Floats = np.sqrt(self._squares / max(self._count, 1.0))
        if not self._count:
            deviation = np.ones(self.size)
        self.mean: Singles = self._mean.astype(np.float32)
        self.scale: Singles = np.maximum(deviation, LEAST).astype(np.float32)


def normalised(rows: Any, mean: Any, scale: Any) -> Any:
    """Rows (B, F), arrays or tensors, scaled to mean 0 and deviation 1, and clipped to +-5."""
    return ((rows - mean) / scale).clip(-FURTHEST, FURTHEST)
