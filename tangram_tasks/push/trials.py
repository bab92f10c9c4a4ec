"""Pushes that are tried in an engine of one's own before one is played.

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
    """The middle of what an episode draws."""
    config, alike = task.config, np.ones(task.layout.tokens)
    spread, finger = float(np.mean(config.spread)), float(np.mean(config.finger_friction))
    return Unknowns(alike, spread * alike, finger, np.zeros((len(alike), 2)))


class Trials:
    """One table after the other."""

    def __init__(self, task: "Push") -> None:
        self._task, self._table = task, PushTable(task.layout, task.config.finger)

    def begin(self, corners: AnyArray, goals: AnyArray, unknowns: Unknowns) -> None:
        """Lay tokens as they are seen, with corners and goals (V, 2)."""
        layout = self._task.layout
        self._corners = np.asarray(corners, np.float64)
        self._poses, self._there = layout.poses(self._corners), on_table(goals, layout)
        self._table.place(self._poses, self._there, unknowns)

    def after(self, action: AnyArray) -> Floats | None:
        """Corners (V, 2) after a push (4,) of what was laid; None where it is refused."""
        layout, config = self._task.layout, self._task.config
        push = push_of(layout, self._corners, action, config.finger, config.longest)
        if push.refused:
            return None
        self._table.lay(self._poses)
        self._table.push(push.begin, push.way)
        return corners_of(layout, self._table.poses(), self._there)
