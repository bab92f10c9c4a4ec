"""Simulation of pushes, in a separate engine, before one is played.

Legend: K tokens, V corners.
"""

from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import AnyArray, Floats
from tangram_sim.world.pushing import PushTable, Unknowns
from tangram_tasks.push.places import corners_of, on_table, push_of

if TYPE_CHECKING:
    from tangram_tasks.push.task import Push


def middle(task: "Push") -> Unknowns:
    """The hidden parameters at the middle of the ranges from which episodes draw."""
    config, alike = task.config, np.ones(task.layout.tokens)
    spread, finger = float(np.mean(config.spread)), float(np.mean(config.finger_friction))
    return Unknowns(alike, spread * alike, finger, np.zeros((len(alike), 2)))


class Trials:
    """A simulated table on which a planner tries pushes, for one table after the other."""

    def __init__(self, task: "Push") -> None:
        self._task, self._table = task, PushTable(task.layout, task.config.finger)

    def begin(self, corners: AnyArray, goals: AnyArray, unknowns: Unknowns) -> None:
        """Lay tokens at observed corners (V, 2); `goals` (V, 2) tell which are on the table."""
        layout = self._task.layout
        self._corners = np.asarray(corners, np.float64)
        self._poses, self._there = layout.poses(self._corners), on_table(goals, layout)
        self._table.place(self._poses, self._there, unknowns)

    def after(self, action: AnyArray) -> Floats | None:
        """Corners (V, 2) after an action (4,) on the tokens as laid; None if it is refused."""
        layout, config = self._task.layout, self._task.config
        push = push_of(layout, self._corners, action, config.finger, config.longest)
        if push.refused:
            return None
        self._table.lay(self._poses)
        self._table.push(push.begin, push.way)
        return corners_of(layout, self._table.poses(), self._there)
