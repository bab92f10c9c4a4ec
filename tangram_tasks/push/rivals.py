"""A planner that learns nothing: it tries random pushes in an engine of its own.

Legend: B environments, K tokens, V corners.
"""

from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_sim.world.pushing import PushTable
from tangram_tasks.push.places import errors, on_table, push_of

if TYPE_CHECKING:
    from tangram_tasks.push.env import PushEnv
    from tangram_tasks.push.task import Push

TRIES = 64


class Planner:
    """Plays the push after which least is left to go, at the middle of what is unknown."""

    def __init__(self, task: "Push", env: "PushEnv", tries: int = TRIES) -> None:
        self._task, self._env, self._tries = task, env, tries
        self._table = PushTable(task.layout, task.config.finger)

    def __call__(self, seen: Arrays, past: History, generators: Generators) -> Singles:  # noqa: ARG002
        """(B, 4) the best of so many random pushes of tokens that are not in place."""
        rows = zip(seen["corners"], seen["goals"], generators, strict=True)
        return np.stack([self._best(*row) for row in rows]).astype(np.float32)

    def _best(self, corners: Floats, goals: Floats, rng: np.random.Generator) -> Floats:
        layout, goals = self._task.layout, np.asarray(goals, np.float64)
        present, poses = on_table(goals, layout), layout.poses(np.asarray(corners, np.float64))
        left = np.flatnonzero(present & ~self._task.placed(corners[None], goals[None])[0])
        if not len(left):
            return np.zeros(4)
        self._table.place(poses, present, self._env.middle)
        tokens = (rng.choice(left, self._tries) + 0.5) / layout.tokens * 2.0 - 1.0
        actions = np.column_stack([tokens, rng.uniform(-1.0, 1.0, (self._tries, 3))])
        costs = [self._cost(poses, present, goals, action) for action in actions]
        best: Floats = actions[int(np.argmin(costs))]
        return best

    def _cost(self, poses: Floats, present: Bools, goals: Floats, action: Floats) -> float:
        """What is left to go after a push, over all tokens, in tolerances."""
        task = self._task
        corners = self._env.corners_of(poses, present)
        push = push_of(task.layout, corners, action, task.config.finger, task.config.longest)
        if push.refused:
            return float("inf")
        self._table.lay(poses)
        self._table.push(push.begin, push.way)
        after = self._env.corners_of(self._table.poses(), present)
        distance, turn = errors(task.layout, after[None], goals[None])
        far = np.hypot(distance[0] / task.config.within, turn[0] / task.config.turned)
        return float((far * present).sum())
