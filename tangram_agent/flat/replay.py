"""Whole episodes, and transitions of them whose goal may be another: hindsight.

Legend: B transitions, E episodes, T steps of an episode, A entries of an action.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tangram_agent.base.ring import Column, Ring
from tangram_agent.flat.config import BaseConfig, EpisodeConfig
from tangram_core.agent import Streams
from tangram_core.arrays import Bools, Ints, Singles
from tangram_core.spec import ACTIONS, Array, Episodes
from tangram_core.task import Task

CPU = torch.device("cpu")
MOVED_SHARE = 0.5  # of a batch, from episodes whose goal was not achieved at their start already


@dataclass(frozen=True, eq=False)
class Transitions:
    """What a batch is made of.

    Attributes:
        rows, steps: (B,) of which episode, by its slot, and which step of it.
        desired: (B, ...) the goals.
        rewards: (B,) for these.
        terminated: (B,) for these.
    """

    rows: Ints
    steps: Ints
    desired: Array
    rewards: Singles
    terminated: Bools


class EpisodeReplay(Ring):
    """The newest episodes, on the processor and where it is learned from them."""

    def __init__(self, task: Task, transitions: int, place: torch.device = CPU) -> None:
        """Room for as many whole episodes as so many transitions make, and for one at least."""
        self._task, self._spec, self._place = task, task.spec, place
        room = self._spec.empty(max(1, transitions // self._spec.horizon))
        every = self._spec.every
        super().__init__({f.name: Column(room[f.name], f.low, f.high) for f in every})
        self._moved = np.zeros(self.capacity, bool)
        goal = self._spec.desired  # comes with each batch
        self._seen = [f for f in self._spec.fields if f.per != "step" and f.name != goal]
        names = [*(field.name for field in self._seen), ACTIONS]
        # On the processor these are the arrays themselves.
        self._held = {name: torch.from_numpy(self.arrays[name]).to(place) for name in names}

    def add(self, episodes: Episodes) -> None:
        """Append episodes; the oldest make room."""
        self._took(self.append(episodes.arrays))

    def _took(self, slots: Ints) -> None:
        """Send what is new to where it is learned from, and note which episodes moved."""
        if self._place.type != "cpu":
            where = torch.from_numpy(slots).to(self._place)
            for name, held in self._held.items():
                held[where] = torch.from_numpy(self.arrays[name][slots]).to(self._place)
        self._look(slots)

    def _look(self, slots: Ints) -> None:
        """Note which episodes came to what would not have been reached at their start."""
        achieved = self.arrays[self._spec.achieved][slots]
        first, last = achieved[:, 0], achieved[:, -1]
        self._moved[slots] = self._task.rewards(first, last) < self._task.rewards(last, last)

    def sample(self, config: BaseConfig, rng: Streams) -> Transitions:
        """A batch, drawn with replacement; a share of it has another goal.

        Raises:
            ValueError: the replay is empty.
        """
        spec, arrays, task = self._spec, self.arrays, self._task
        rows = self._chosen(config, rng["replay"])
        steps = rng["replay"].integers(spec.horizon, size=config.batch_size)
        ends = np.full(config.batch_size, spec.horizon)
        desired, other = self.goals(config, rows, steps, ends, rng["hindsight"])
        recorded = arrays["terminated"][rows, steps].astype(bool)
        achieved = arrays[spec.achieved][rows, steps + 1]
        rewards = task.rewards(achieved, desired)
        return Transitions(
            rows,
            steps,
            desired,
            np.where(other, rewards, arrays["rewards"][rows, steps]).astype(np.float32),
            np.where(other, task.ended(achieved, desired, recorded), recorded),
        )

    def goals(
        self, config: EpisodeConfig, rows: Ints, steps: Ints, ends: Ints, rng: np.random.Generator
    ) -> tuple[Array, Bools]:
        """Goals (B, ...) of steps (B,) of episodes that end at moments (B,), and which are others.

        A goal that another moment achieved is one that the step might have been made for, and the
        task says what it would have been worth (Andrychowicz et al. 2017).
        """
        other = rng.random(len(rows)) < config.relabel_share
        moments = later(steps, ends, rng)
        desired = self.arrays[self._spec.desired][rows]
        reached = self.arrays[self._spec.achieved][rows[other], moments[other]]
        desired[other] = self.relabelled(desired[other], reached, rng)
        return desired, other

    def relabelled(self, desired: Array, reached: Array, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """(n, ...) goals that take the place of the desired ones, of those that were reached."""
        return reached

    def seen(self, rows: Tensor, moments: Tensor, desired: Tensor) -> dict[str, Tensor]:
        """What was seen in episodes (B,) at moments (B,), with goals (B, ...); B rows each."""
        where = rows * (self._spec.horizon + 1) + moments
        seen = {self._spec.desired: desired}
        for field in self._seen:
            held, moment = self._held[field.name], field.per == "moment"
            kept = held.flatten(0, 1) if moment else held
            seen[field.name] = kept.index_select(0, where if moment else rows)
        return seen

    def actions(self, rows: Tensor, steps: Tensor) -> Tensor:
        """(B, A) what was done in episodes (B,) at steps (B,)."""
        where = rows * self._spec.horizon + steps
        return self._held[ACTIONS].flatten(0, 1).index_select(0, where)

    def _chosen(self, config: BaseConfig, rng: np.random.Generator) -> Ints:
        """(B,) episodes, by their slots; some of those that moved, where there are such.

        Where little moves at first, most achieved goals are reached whatever is done, and teach
        nothing (after Zhao and Tresp 2018, who weigh episodes by energy).
        """
        rows, moved = self.drawn(config.batch_size, rng), np.flatnonzero(self._moved)
        if len(moved):
            own = rng.random(config.batch_size) < MOVED_SHARE
            rows[own] = moved[rng.integers(len(moved), size=own.sum())]
        return rows

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state, see `Ring`."""
        super().load_state(state)
        self._moved[:] = False
        self._took(self._slots())


def later(steps: Ints, ends: Ints, rng: np.random.Generator) -> Ints:
    """(B,) a moment after each of these steps, any up to the end."""
    ahead: Ints = np.floor(rng.random(len(steps)) * (ends - steps)).astype(np.int64)
    return steps + 1 + ahead
