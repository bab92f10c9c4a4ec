"""What an episode is made of: named arrays with their types, shapes and bounds.

Legend: E episodes, B environments that play in step, T steps of an episode, A entries of an action.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tangram_core.arrays import Singles
from tangram_core.errors import ConfigError

Array = npt.NDArray[Any]
Arrays = Mapping[str, Array]
Per = Literal["moment", "step", "episode"]

ACTIONS, REWARDS, TERMINATED = "actions", "rewards", "terminated"
OWN = (ACTIONS, REWARDS, TERMINATED)  # names that every task has
DTYPES = ("f4", "u1")
MAX_REWARD = 1e6


@dataclass(frozen=True)
class Field:
    """One of the arrays that an episode consists of.

    Attributes:
        name: in the arrays of an episode, and in front of every reason why one is refused.
        shape: of one row: of what there is at one moment, of one step, or of one episode.
        low, high: bounds of every value. They are checked, never clipped to: choose them so wide
            that only what is wrong lies beyond.
        per: moment: T + 1 rows, before each step and after the last; step: T rows; episode: one.
        dtype: f4 for numbers, u1 for flags and pixels.
    """

    name: str
    shape: tuple[int, ...]
    low: float
    high: float
    per: Per = "moment"
    dtype: str = "f4"

    def __post_init__(self) -> None:
        if not self.low < self.high or not math.isfinite(self.low) or not math.isfinite(self.high):
            raise ConfigError(
                f"field {self.name}: its bounds must be finite, the lower one first, got "
                f"{self.low:g} and {self.high:g}: give bounds that only what is wrong breaks"
            )
        if self.dtype not in DTYPES:
            raise ConfigError(
                f"field {self.name}: its dtype must be one of {', '.join(DTYPES)}, got {self.dtype}"
            )
        if any(size < 1 for size in self.shape):
            raise ConfigError(f"field {self.name}: its shape has an empty side, {self.shape}")

    def rows(self, horizon: int) -> tuple[int, ...]:
        """The shape of one whole episode of so many steps."""
        before = {"moment": (horizon + 1,), "step": (horizon,), "episode": ()}[self.per]
        return (*before, *self.shape)


@dataclass(frozen=True)
class EpisodeSpec:
    """What the episodes of a task are made of.

    Attributes:
        horizon: T, steps of every episode. What ends early plays on, and is marked `terminated`.
        action_size: A; every entry of an action lies in [-1, 1].
        fields: what is observed.
        achieved: name of the field, one of each moment, that a goal is compared with.
        desired: name of the field, one of each episode, that is the goal that was played for.
        rewards: the least and the largest reward there can be.
    """

    horizon: int
    action_size: int
    fields: tuple[Field, ...]
    achieved: str
    desired: str
    rewards: tuple[float, float] = (-MAX_REWARD, MAX_REWARD)

    def __post_init__(self) -> None:
        for name, value in (("horizon", self.horizon), ("action_size", self.action_size)):
            if value < 1:
                raise ConfigError(f"an episode's {name} must be at least 1, got {value}")
        names = [field.name for field in self.every]
        if len(set(names)) < len(names):
            raise ConfigError(f"two fields of an episode have one name: {', '.join(sorted(names))}")
        for role, per in ((self.achieved, "moment"), (self.desired, "episode")):
            if role not in names or self.field(role).per != per:
                raise ConfigError(f"an episode has no field {role} with one row for each {per}")

    @cached_property
    def every(self) -> tuple[Field, ...]:
        """All fields, in the order in which they travel: what is observed, then `OWN`."""
        return (
            *self.fields,
            Field(ACTIONS, (self.action_size,), -1.0, 1.0, "step"),
            Field(REWARDS, (), *self.rewards, "step"),
            Field(TERMINATED, (), 0, 1, "step", "u1"),
        )

    def field(self, name: str) -> Field:
        """The field of this name."""
        return next(field for field in self.every if field.name == name)

    def empty(self, count: int) -> "Episodes":
        """Room for so many episodes."""
        shapes = {field.name: (count, *field.rows(self.horizon)) for field in self.every}
        return Episodes(
            {field.name: np.zeros(shapes[field.name], field.dtype) for field in self.every}
        )


@dataclass(frozen=True, eq=False)
class Episodes:
    """Whole episodes of equal length, as they were played: what a worker sends.

    Attributes:
        arrays: by the names of an `EpisodeSpec`, each (E, rows of a moment, step or episode, ...).
    """

    arrays: Arrays

    def __getitem__(self, name: str) -> Array:
        return self.arrays[name]

    @property
    def actions(self) -> Singles:
        """(E, T, A) float32 in [-1, 1]."""
        return self.arrays[ACTIONS]

    @property
    def rewards(self) -> Singles:
        """(E, T) float32 of the goal that was played for."""
        return self.arrays[REWARDS]

    @property
    def terminated(self) -> npt.NDArray[np.uint8]:
        """(E, T) 1 where nothing that follows the step counts; a time limit is not marked."""
        return self.arrays[TERMINATED]

    @property
    def count(self) -> int:
        """E."""
        return len(self.actions)

    @property
    def steps(self) -> int:
        """T."""
        return int(self.actions.shape[1])

    @property
    def transitions(self) -> int:
        """E * T."""
        return self.count * self.steps

    def at(self, rows: Any) -> "Episodes":
        """The episodes at an index, a slice or where a mask is set."""
        return Episodes({name: array[rows] for name, array in self.arrays.items()})


def joined(parts: Iterable[Episodes]) -> Episodes:
    """All episodes in one."""
    every = list(parts)
    return Episodes({n: np.concatenate([one[n] for one in every]) for n in every[0].arrays})
