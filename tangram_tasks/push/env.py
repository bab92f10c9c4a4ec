"""Tables on which a finger pushes tokens, several in step.

Legend: B environments, K tokens, V corners.
"""

from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Env, Generators, Step
from tangram_sim.world.pushing import PushTable, Unknowns
from tangram_tasks.push.places import AWAY, begin, push_of

if TYPE_CHECKING:
    from tangram_tasks.push.task import Push


class PushEnv(Env):
    """B tables; see `Push`.

    Attributes:
        refused: (B,) why the last push moved nothing, empty where it could.
        unknowns: (B,) what was drawn for the episode: for planners that are told.
    """

    def __init__(self, task: "Push", count: int) -> None:
        """Set up the tables."""
        self.count, self._task = count, task
        self.tables = [PushTable(task.layout, task.config.finger) for _ in range(count)]
        shape = (count, task.layout.corner_count, 2)
        self.corners: Floats = np.full(shape, AWAY)
        self.goals: Floats = np.full(shape, AWAY)
        self._present: Bools = np.zeros((count, task.layout.tokens), np.bool_)
        self.refused, self._ended = [""] * count, np.zeros(count, np.bool_)
        self.unknowns = [self.middle] * count

    def reset(self, generators: Generators) -> Arrays:
        """Lay out an episode on every table."""
        layout = self._task.layout
        for b, rng in enumerate(generators):
            tokens, starts, goals = begin(layout, self._task.count, rng)
            present, every, desired = self._present[b], *np.zeros((2, layout.tokens, 3))
            present[:] = False
            present[tokens], every[tokens], desired[tokens] = True, starts, goals
            self.unknowns[b] = self._drawn(rng)
            self.tables[b].place(every, present, self.unknowns[b])
            self.goals[b] = self.corners_of(desired, present)
            self.corners[b] = self.corners_of(every, present)
        self.refused, self._ended = [""] * self.count, np.zeros(self.count, np.bool_)
        return self._seen()

    def step(self, actions: Singles) -> Step:
        """Push once on every table on which not all is in place."""
        layout, config = self._task.layout, self._task.config
        self.refused = [""] * self.count
        for b in np.flatnonzero(~self._ended).tolist():
            action = actions[b]
            push = push_of(layout, self.corners[b], action, config.finger, config.longest)
            self.refused[b] = push.refused
            if not push.refused:
                self.tables[b].push(push.begin, push.way)
                self.corners[b] = self.corners_of(self.tables[b].poses(), self._present[b])
        # As the master has them, which comes to the same reward.
        corners, goals = self.corners.astype(np.float32), self.goals.astype(np.float32)
        placed = self._task.placed(corners, goals)
        rewards = self._task.paid(placed, self._present)
        self._ended = np.asarray(placed.all(axis=1))
        return Step(self._seen(), rewards, self._ended.copy())

    def facts(self) -> Arrays:
        """Exact corners and goals, and whether the last push was refused."""
        return {
            "corners": self.corners.copy(),
            "goals": self.goals.copy(),
            "refused": np.array([bool(why) for why in self.refused]),
        }

    def close(self) -> None:
        """End the engine's clients."""
        for table in self.tables:
            table.close()

    @property
    def middle(self) -> Unknowns:
        """The middle of what is drawn."""
        config, alike = self._task.config, np.ones(self._task.layout.tokens)
        spread, finger = float(np.mean(config.spread)), float(np.mean(config.finger_friction))
        return Unknowns(alike, spread * alike, finger, np.zeros((len(alike), 2)))

    def _drawn(self, rng: np.random.Generator) -> Unknowns:
        """Frictions and centres of mass of an episode."""
        layout, config = self._task.layout, self._task.config
        tokens, own = layout.tokens, config.table_friction
        spread, finger = config.spread, config.finger_friction
        if config.friction == "fixed":
            return self.middle
        angle, share = rng.uniform(-np.pi, np.pi, tokens), np.sqrt(rng.random(tokens))
        around = share[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return Unknowns(
            rng.uniform(own[0], own[1], tokens),
            rng.uniform(spread[0], spread[1], tokens),
            float(rng.uniform(finger[0], finger[1])),
            config.centre * layout.radii[:, None] * around,
        )

    def corners_of(self, poses: Floats, present: Bools) -> Floats:
        """(V, 2) of poses (K, 3); AWAY those that are not on the table."""
        corners = self._task.layout.corners(poses)
        corners[~present[self._task.layout.token_of_corner]] = AWAY
        return corners

    def _seen(self) -> Arrays:
        return {"corners": self.corners.copy(), "goals": self.goals.copy()}
