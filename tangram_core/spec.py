"""The arrays of an episode: names, types, shapes and bounds.

Legend: E episodes, B environments that play in step, T steps of an episode, A entries of an action.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tangram_core.arrays import Ints, Singles
from tangram_core.errors import ConfigError

Array = npt.NDArray[Any]
Arrays = Mapping[str, Array]
Per = Literal["moment", "step", "episode"]

ACTIONS, REWARDS, TERMINATED = "actions", "rewards", "terminated"
OWN = (ACTIONS, REWARDS, TERMINATED)  # arrays that every task has
DTYPES = ("f4", "u1")
MAX_REWARD = 1e6


@dataclass(frozen=True)
class Field:
    """Declaration of one array of an episode.

    Attributes:
        name: name of the array in an episode and in errors.
        shape: shape of one row: at one moment, in one step, or for a whole episode.
        low, high: bounds of every value. A value outside is an error, it is not clipped: choose
            bounds that only wrong values break.
        per: moment: T + 1 rows, before each step and after the last; step: T rows; episode: one.
        dtype: f4 (float32) for numbers, u1 (uint8) for flags and pixels.
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
                f"{self.low:g} and {self.high:g}: give bounds that only wrong values break"
            )
        if self.dtype not in DTYPES:
            raise ConfigError(
                f"field {self.name}: its dtype must be one of {', '.join(DTYPES)}, got {self.dtype}"
            )
        if any(size < 1 for size in self.shape):
            raise ConfigError(f"field {self.name}: its shape has an empty side, {self.shape}")

    def rows(self, horizon: int) -> tuple[int, ...]:
        """The shape of the array in an episode of `horizon` steps."""
        before = {"moment": (horizon + 1,), "step": (horizon,), "episode": ()}[self.per]
        return (*before, *self.shape)


@dataclass(frozen=True)
class EpisodeSpec:
    """Names, shapes and bounds of the arrays in an episode of a task.

    Attributes:
        horizon: T, steps of every episode. An episode that ends early is marked `terminated` and
            plays on to T.
        action_size: A; every entry of an action lies in [-1, 1].
        fields: the observed arrays.
        achieved: name of the field with the achieved goal; it has one row for each moment.
        desired: name of the field with the desired goal; it has one row for each episode.
        rewards: least and largest possible reward.
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
        """All fields in the order of a message: the observed ones, then those of `OWN`."""
        return (
            *self.fields,
            Field(ACTIONS, (self.action_size,), -1.0, 1.0, "step"),
            Field(REWARDS, (), *self.rewards, "step"),
            Field(TERMINATED, (), 0, 1, "step", "u1"),
        )

    def field(self, name: str) -> Field:
        """The field called `name`."""
        return next(field for field in self.every if field.name == name)

    def empty(self, count: int) -> "Episodes":
        """Episodes filled with zeros, `count` of them."""
        shapes = {field.name: (count, *field.rows(self.horizon)) for field in self.every}
        return Episodes(
            {field.name: np.zeros(shapes[field.name], field.dtype) for field in self.every}
        )


@dataclass(frozen=True, eq=False)
class Episodes:
    """Whole episodes of equal length, as a worker plays and sends them.

    Attributes:
        arrays: field name -> array (E, T + 1, ...), (E, T, ...) or (E, ...), see `Field.per`.
    """

    arrays: Arrays

    def __getitem__(self, name: str) -> Array:
        return self.arrays[name]

    @property
    def actions(self) -> Singles:
        """Actions (E, T, A) float32 in [-1, 1]."""
        return self.arrays[ACTIONS]

    @property
    def rewards(self) -> Singles:
        """Rewards (E, T) float32 for the desired goal."""
        return self.arrays[REWARDS]

    @property
    def terminated(self) -> npt.NDArray[np.uint8]:
        """Flags (E, T): 1 if the task ended with the step; 0 at a time limit."""
        return self.arrays[TERMINATED]

    @property
    def count(self) -> int:
        """E, the number of episodes."""
        return len(self.actions)

    @property
    def steps(self) -> int:
        """T, the steps of an episode."""
        return int(self.actions.shape[1])

    @property
    def transitions(self) -> int:
        """E * T, the number of transitions."""
        return self.count * self.steps

    @property
    def lengths(self) -> Ints:
        """Steps (E,) until each episode first terminated; T if it did not."""
        ended = self.terminated.astype(bool)
        counts: Ints = np.where(ended.any(1), ended.argmax(1) + 1, ended.shape[1])
        return counts

    def at(self, rows: Any) -> "Episodes":
        """The selected episodes; `rows`: an index array, a slice or a mask."""
        return Episodes({name: array[rows] for name, array in self.arrays.items()})
