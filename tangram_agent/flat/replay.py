"""Whole episodes, and transitions of them whose goal may be another: hindsight.

Legend: B transitions, E episodes, T steps of an episode, A entries of an action.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tangram_agent.base.ring import Column, Ring
from tangram_agent.flat.config import BaseConfig
from tangram_core.agent import Streams
from tangram_core.arrays import Bools, Ints, Singles
from tangram_core.spec import Array, Arrays, Episodes
from tangram_core.task import Task


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


class EpisodeReplay(Ring):
    """The newest episodes."""

    def __init__(self, task: Task, transitions: int) -> None:
        """Room for as many whole episodes as so many transitions make, and for one at least."""
        self._task, self._spec = task, task.spec
        room = self._spec.empty(max(1, transitions // self._spec.horizon))
        every = self._spec.every
        super().__init__({f.name: Column(room[f.name], f.low, f.high) for f in every})
        self._moved = np.zeros(self.capacity, bool)

    def add(self, episodes: Episodes) -> None:
        """Append episodes; the oldest make room."""
        self._look(self.append(episodes.arrays))

    def _look(self, slots: Ints) -> None:
        """Note which episodes came to what would not have been reached at their start."""
        achieved = self.arrays[self._spec.achieved][slots]
        first, last = achieved[:, 0], achieved[:, -1]
        self._moved[slots] = self._task.rewards(first, last) < self._task.rewards(last, last)

    def sample(self, config: BaseConfig, rng: Streams) -> Transitions:
        """A batch, drawn with replacement; a share of it has another goal.

        A goal that another moment achieved is one that the step might have been made for, and the
        task says what it would have been worth (Andrychowicz et al. 2017).

        Raises:
            ValueError: the replay is empty.
        """
        spec, arrays, task = self._spec, self.arrays, self._task
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
        rows, moved = self.drawn(config.batch_size, rng), np.flatnonzero(self._moved)
        if len(moved):
            own = rng.random(config.batch_size) < config.moved_share
            rows[own] = moved[rng.integers(len(moved), size=own.sum())]
        return rows

    def _seen(self, rows: Ints, moments: Ints, desired: Array) -> Arrays:
        """What was seen at these moments, with these goals."""
        seen = {
            field.name: self.arrays[field.name][rows, moments]
            if field.per == "moment"
            else self.arrays[field.name][rows]
            for field in self._spec.fields
            if field.per != "step"
        }
        return seen | {self._spec.desired: desired}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state, see `Ring`."""
        super().load_state(state)
        self._moved[:] = False
        self._look(self._slots())


def later(steps: Ints, horizon: int, goals: tuple[str, ...], rng: np.random.Generator) -> Ints:
    """(B,) a moment after each of these steps: of one of the kinds of `BaseConfig.goals`."""
    count = len(steps)
    kinds = rng.integers(len(goals), size=count)
    future = steps + 1 + np.floor(rng.random(count) * (horizon - steps)).astype(np.int64)
    moments = {"future": future, "next": steps + 1, "final": np.full(count, horizon)}
    chosen: Ints = np.stack([moments[kind] for kind in goals])[kinds, np.arange(count)]
    return chosen
