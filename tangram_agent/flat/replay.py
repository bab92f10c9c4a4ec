"""The replay buffer of whole episodes, whose transitions are drawn with hindsight goals.

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
MOVED_SHARE = 0.5  # share of a batch from episodes in which something moved


@dataclass(frozen=True, eq=False)
class Transitions:
    """A batch of drawn transitions.

    Attributes:
        rows, steps: (B,) slot of the episode, and step in the episode.
        desired: (B, ...) the desired goals.
        rewards: (B,) rewards for these goals.
        terminated: (B,) whether the step terminated the episode for these goals.
    """

    rows: Ints
    steps: Ints
    desired: Array
    rewards: Singles
    terminated: Bools


class EpisodeReplay(Ring):
    """Replay buffer of the newest episodes, on the CPU and on the learner's device."""

    def __init__(self, task: Task, transitions: int, place: torch.device = CPU) -> None:
        """Make room for so many transitions in whole episodes, at least for one episode."""
        self._task, self._spec, self._place = task, task.spec, place
        room = self._spec.empty(max(1, transitions // self._spec.horizon))
        every = self._spec.every
        super().__init__({f.name: Column(room[f.name], f.low, f.high) for f in every})
        self._moved = np.zeros(self.capacity, bool)
        goal = self._spec.desired  # comes with each batch
        self._seen = [f for f in self._spec.fields if f.per != "step" and f.name != goal]
        names = [*(field.name for field in self._seen), ACTIONS]
        # On a CPU these tensors share memory with the arrays.
        self._held = {name: torch.from_numpy(self.arrays[name]).to(place) for name in names}

    def add(self, episodes: Episodes) -> None:
        """Append episodes and drop the oldest beyond the capacity."""
        self._took(self.append(episodes.arrays))

    def _took(self, slots: Ints) -> None:
        """Copy new episodes to the learner's device, and note in which of them something moved."""
        if self._place.type != "cpu":
            where = torch.from_numpy(slots).to(self._place)
            for name, held in self._held.items():
                held[where] = torch.from_numpy(self.arrays[name][slots]).to(self._place)
        self._look(slots)

    def _look(self, slots: Ints) -> None:
        """Note in which episodes the goal achieved at the end was not yet achieved at the start."""
        achieved = self.arrays[self._spec.achieved][slots]
        first, last = achieved[:, 0], achieved[:, -1]
        self._moved[slots] = self._task.rewards(first, last) < self._task.rewards(last, last)

    def sample(self, config: BaseConfig, rng: Streams) -> Transitions:
        """A batch, drawn with replacement; a share of it has hindsight goals.

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
        """Goals (B, ...) of steps (B,) in episodes with ends (B,), and whether each is relabelled.

        A relabelled step gets a goal that its episode achieved later (Andrychowicz et al. 2017).
        """
        other = rng.random(len(rows)) < config.relabel_share
        moments = later(steps, ends, rng)
        desired = self.arrays[self._spec.desired][rows]
        reached = self.arrays[self._spec.achieved][rows[other], moments[other]]
        desired[other] = self.relabelled(desired[other], reached, rng)
        return desired, other

    def relabelled(self, desired: Array, reached: Array, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """Goals (n, ...) that replace the desired ones, made of the reached ones."""
        return reached

    def seen(self, rows: Tensor, moments: Tensor, desired: Tensor) -> dict[str, Tensor]:
        """Fields of episodes (B,) at moments (B,) with goals (B, ...), by name; B rows each."""
        where = rows * (self._spec.horizon + 1) + moments
        seen = {self._spec.desired: desired}
        for field in self._seen:
            held, moment = self._held[field.name], field.per == "moment"
            kept = held.flatten(0, 1) if moment else held
            seen[field.name] = kept.index_select(0, where if moment else rows)
        return seen

    def actions(self, rows: Tensor, steps: Tensor) -> Tensor:
        """Actions (B, A) in episodes (B,) at steps (B,)."""
        where = rows * self._spec.horizon + steps
        return self._held[ACTIONS].flatten(0, 1).index_select(0, where)

    def _chosen(self, config: BaseConfig, rng: np.random.Generator) -> Ints:
        """Slots (B,) of drawn episodes; a share from those in which something moved.

        At first little may move. Then most achieved goals are reached by any action, and teach
        nothing (after Zhao and Tresp 2018, who weigh episodes by energy).
        """
        rows, moved = self.drawn(config.batch_size, rng), np.flatnonzero(self._moved)
        if len(moved):
            own = rng.random(config.batch_size) < MOVED_SHARE
            rows[own] = moved[rng.integers(len(moved), size=own.sum())]
        return rows

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Load a state, see `Ring.load_state`."""
        super().load_state(state)
        self._moved[:] = False
        self._took(self._slots())


def later(steps: Ints, ends: Ints, rng: np.random.Generator) -> Ints:
    """Random moments (B,) after each of these steps, up to the ends of their episodes."""
    ahead: Ints = np.floor(rng.random(len(steps)) * (ends - steps)).astype(np.int64)
    return steps + 1 + ahead
