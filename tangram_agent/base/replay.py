"""Whole episodes, and transitions of them whose goal may be another: hindsight.

Legend: B transitions, E episodes, T steps of an episode, A entries of an action.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tangram_agent.base.config import BaseConfig
from tangram_core.agent import Streams
from tangram_core.spec import Array, Arrays, Episodes
from tangram_core.task import Task
from tangram_sim.arrays import Bools, Ints, Singles
from tangram_sim.errors import RunError

_COUNTER = "added"


@dataclass(frozen=True, eq=False)
class Transitions:
    """What a batch is made of.

    Attributes:
        before, after: fields of the moment and of the episode, B rows each.
        actions: (B, A).
        rewards: (B,) for the goal that stands in both.
        terminated: (B,) for that goal.
    """

    before: Arrays
    after: Arrays
    actions: Singles
    rewards: Singles
    terminated: Bools


class EpisodeReplay:
    """The newest episodes, in a ring over preallocated arrays.

    Attributes:
        capacity: episodes kept.
        added: episodes ever added; the next one goes to slot `added % capacity`.
    """

    def __init__(self, task: Task, transitions: int) -> None:
        """Room for as many whole episodes as so many transitions make, and for one at least."""
        self._task, self._spec = task, task.spec
        self.capacity, self.added = max(1, transitions // self._spec.horizon), 0
        self._lost = 0  # episodes that were added and not taken over with a state
        self._moved = np.zeros(self.capacity, bool)
        self._arrays = dict(self._spec.empty(self.capacity).arrays)

    def __len__(self) -> int:
        return min(self.added - self._lost, self.capacity)

    def add(self, episodes: Episodes) -> None:
        """Append episodes; the oldest make room."""
        kept = min(episodes.count, self.capacity)
        slots = (self.added + episodes.count - kept + np.arange(kept)) % self.capacity
        for name, array in self._arrays.items():
            array[slots] = episodes[name][episodes.count - kept :]
        self.added += episodes.count
        self._look(slots)

    def _look(self, slots: Ints) -> None:
        """Note which episodes came to what would not have been reached at their start."""
        achieved = self._arrays[self._spec.achieved][slots]
        first, last = achieved[:, 0], achieved[:, -1]
        self._moved[slots] = self._task.rewards(first, last) < self._task.rewards(last, last)

    def sample(self, config: BaseConfig, rng: Streams) -> Transitions:
        """A batch, drawn with replacement; a share of it has another goal.

        A goal that another moment achieved is one that the step might have been made for, and the
        task says what it would have been worth (Andrychowicz et al. 2017).

        Raises:
            ValueError: the replay is empty.
        """
        if not len(self):
            raise ValueError("cannot sample from an empty replay")
        spec, arrays, task = self._spec, self._arrays, self._task
        rows = self._chosen(config, rng["replay"])
        steps = rng["replay"].integers(spec.horizon, size=config.batch_size)
        other = rng["hindsight"].random(config.batch_size) < config.relabel_share
        moments = later(steps, spec.horizon, config.goals, rng["hindsight"])
        desired = arrays[spec.desired][rows]
        desired[other] = arrays[spec.achieved][rows[other], moments[other]]
        before, after = self._seen(rows, steps, desired), self._seen(rows, steps + 1, desired)
        recorded = arrays["terminated"][rows, steps].astype(bool)
        achieved = after[spec.achieved]
        rewards = task.rewards(achieved, desired)
        return Transitions(
            before,
            after,
            arrays["actions"][rows, steps],
            np.where(other, rewards, arrays["rewards"][rows, steps]).astype(np.float32),
            np.where(other, task.ended(achieved, desired, recorded), recorded),
        )

    def _chosen(self, config: BaseConfig, rng: np.random.Generator) -> Ints:
        """(B,) episodes, by their slots; some of those that moved, where there are such.

        Where little moves at first, most achieved goals are reached whatever is done, and teach
        nothing (after Zhao and Tresp 2018, who weigh episodes by energy).
        """
        oldest, count = self.added - len(self), config.batch_size
        rows = (oldest + rng.integers(len(self), size=count)) % self.capacity
        moved = np.flatnonzero(self._moved)
        if len(moved):
            own = rng.random(count) < config.moved_share
            rows[own] = moved[rng.integers(len(moved), size=own.sum())]
        return rows

    def _seen(self, rows: Ints, moments: Ints, desired: Array) -> Arrays:
        """What was seen at these moments, with these goals."""
        seen = {
            field.name: self._arrays[field.name][rows, moments]
            if field.per == "moment"
            else self._arrays[field.name][rows]
            for field in self._spec.fields
            if field.per != "step"
        }
        return seen | {self._spec.desired: desired}

    def state(self) -> dict[str, Array]:
        """The kept episodes, as they lie (views), and the counter.

        Episode n that was ever added lies at n modulo the number of those kept.
        """
        kept = len(self)
        if kept < self.capacity and self._lost:  # a full ring that was given more room
            slots = np.roll(
                (self.added - kept + np.arange(kept)) % self.capacity, self.added % kept
            )
            arrays = {name: array[slots] for name, array in self._arrays.items()}
        else:
            arrays = {name: array[:kept] for name, array in self._arrays.items()}
        return arrays | {_COUNTER: np.array([self.added], np.int64)}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state; of more episodes than there is room for, the newest.

        Raises:
            RunError: arrays are missing, of another task, or beyond their bounds.
        """
        added = int(state[_COUNTER][0]) if _COUNTER in state else -1
        kept = len(state.get("actions", ()))
        for field in self._spec.every:
            part, wanted = state.get(field.name), self._arrays[field.name]
            if (
                part is None
                or part.shape != (kept, *wanted.shape[1:])
                or part.dtype != wanted.dtype
                or added < kept
                or not ((field.low <= part) & (part <= field.high)).all()  # nor is a NaN
            ):
                raise RunError(
                    f"replay state: '{field.name}' must be {wanted.dtype} "
                    f"{(kept, *wanted.shape[1:])} within {field.low:g} and {field.high:g}: it is "
                    "of another task, or damaged: start a new run"
                )
        order = np.roll(np.arange(kept), -(added % kept) if kept else 0)[-self.capacity :]
        self.added, self._lost = added, added - len(order)
        slots = (self._lost + np.arange(len(order))) % self.capacity
        for name, array in self._arrays.items():
            array[slots] = state[name][order]
        self._moved[:] = False
        self._look(slots)


def later(steps: Ints, horizon: int, goals: tuple[str, ...], rng: np.random.Generator) -> Ints:
    """(B,) a moment after each of these steps: of one of the kinds of `BaseConfig.goals`."""
    count = len(steps)
    kinds = rng.integers(len(goals), size=count)
    future = steps + 1 + np.floor(rng.random(count) * (horizon - steps)).astype(np.int64)
    moments = {"future": future, "next": steps + 1, "final": np.full(count, horizon)}
    chosen: Ints = np.stack([moments[kind] for kind in goals])[kinds, np.arange(count)]
    return chosen
