"""Environments of task=push: several tables in one process.

Legend: B environments, K tokens, V corners.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Env, Generators, Json, Step
from tangram_sim.world.arm import METRES, Panda
from tangram_sim.world.pushing import PushTable, Unknowns
from tangram_tasks.push.places import ARENA, AWAY, begin, corners_of, push_of
from tangram_tasks.push.trials import middle

if TYPE_CHECKING:
    from tangram_tasks.push.task import Push


class PushEnv(Env):
    """B simulated tables; see `Push`.

    Attributes:
        refused: (B,) why the last push moved nothing; empty if it was made.
        unknowns: (B,) hidden parameters of the episode, for planners that may know them.
        corners, goals: (B, V, 2) exact corners of the tokens and of their places.
    """

    def __init__(self, task: "Push", count: int, fewer: Sequence[float] = ()) -> None:
        """Set up the tables; `fewer` has weights of 1, 2, ... tokens, empty: always task.count."""
        self.count, self._task = count, task
        some = np.array(fewer[: task.count])
        self._fewer = some / some.sum() if some.any() else some[:0]
        self.tables = [PushTable(task.layout, task.config.finger) for _ in range(count)]
        self.arms = [Panda() for _ in range(count if task.config.hand == "panda" else 0)]
        shape = (count, task.layout.corner_count, 2)
        self.corners: Floats = np.full(shape, AWAY)
        self.goals: Floats = np.full(shape, AWAY)
        self._cameras = []
        if task.config.pixels:  # imported only if needed: it takes time and memory
            from tangram_tasks.push.looking import Camera  # noqa: PLC0415

            self._cameras = [Camera(task.layout, task.config.pixels) for _ in range(count)]
        # Corners as the agent sees them; pushes refer to these.
        self._shown = self.corners.copy() if self._cameras else self.corners
        self._present: Bools = np.zeros((count, task.layout.tokens), np.bool_)
        self.refused, self._ended = [""] * count, np.zeros(count, np.bool_)
        self.unknowns = [middle(task)] * count

    def reset(self, generators: Generators) -> Arrays:
        """Lay out an episode on every table."""
        layout = self._task.layout
        for b, rng in enumerate(generators):
            count, figures = self._task.count, self._task.figures
            if len(self._fewer):
                count = 1 + int(rng.choice(len(self._fewer), p=self._fewer))
            whole = count == layout.tokens
            tokens, starts, goals = begin(layout, count, rng, figures if whole else ())
            present, every, desired = self._present[b], *np.zeros((2, layout.tokens, 3))
            present[:] = False
            present[tokens], every[tokens], desired[tokens] = True, starts, goals
            self.unknowns[b] = self._drawn(rng)
            self.tables[b].place(every, present, self.unknowns[b])
            if self.arms:
                self.arms[b].home()
            self.goals[b] = corners_of(layout, desired, present)
            self.corners[b] = corners_of(layout, every, present)
            if self._cameras:
                self._shown[b] = self._cameras[b].begin(self.corners[b], present)
        self.refused, self._ended = [""] * self.count, np.zeros(self.count, np.bool_)
        return self._seen()

    def step(self, actions: Singles) -> Step:
        """Push once on every table whose episode has not terminated."""
        layout, config = self._task.layout, self._task.config
        self.refused = [""] * self.count
        for b in np.flatnonzero(~self._ended).tolist():
            action = actions[b]
            push = push_of(layout, self._shown[b], action, config.finger, config.longest)
            self.refused[b] = push.refused or self._push(b, push.begin, push.way)
            if not self.refused[b]:
                poses, there = self.tables[b].poses(), self._present[b]
                self.corners[b] = corners_of(layout, poses, there)
                if self._cameras:
                    self._shown[b] = self._cameras[b].after(self.corners[b], push.token)
        # Rounded as on the master, so that it computes the same reward.
        corners, goals = self._shown.astype(np.float32), self.goals.astype(np.float32)
        placed = self._task.placed(corners, goals)
        rewards = self._task.paid(placed, self._present)
        self._ended = np.asarray(placed.all(axis=1))
        return Step(self._seen(), rewards, self._ended.copy())

    def _push(self, b: int, begin: Floats, way: Floats) -> str:
        """Push on a table; returns why the arm cannot, empty if it can."""
        path = np.stack([begin, begin + way])
        if self.arms:
            motion = self.arms[b].push(begin * METRES, way * METRES)
            if motion is None:
                return "the arm cannot reach there"
            path = motion.pushed / METRES
        for _ in self.tables[b].follow(path):
            pass
        return ""

    def facts(self) -> Arrays:
        """Exact corners and goals, whether the last push was refused, and hidden parameters."""
        unknowns = [asdict(one) for one in self.unknowns]
        return {name: np.array([one[name] for one in unknowns]) for name in unknowns[0]} | {
            "corners": self.corners.copy(),
            "goals": self.goals.copy(),
            "refused": np.array([bool(why) for why in self.refused]),
        }

    def told(self) -> Json:
        """Why the last push of the first table moved nothing; empty if it was made."""
        return {"refused": self.refused[0]} if self.refused[0] else {}

    def picture(self, size: int) -> Pixels:
        """Draw the first table from above, (size, size, 3)."""
        from tangram_sim.drawing.scenes import draw_scene  # noqa: PLC0415

        scene = (self.corners[0], self.goals[0], size, None)
        return np.asarray(draw_scene(self._task.layout, ARENA, *scene), np.uint8)

    def close(self) -> None:
        """Close the engines of all tables and arms."""
        for table in self.tables:
            table.close()
        for arm in self.arms:
            arm.close()

    def _drawn(self, rng: np.random.Generator) -> Unknowns:
        """Draw frictions and centres of mass for an episode."""
        layout, config = self._task.layout, self._task.config
        tokens, own = layout.tokens, config.table_friction
        spread, finger = config.spread, config.finger_friction
        angle, share = rng.uniform(-np.pi, np.pi, tokens), np.sqrt(rng.random(tokens))
        around = share[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return Unknowns(
            rng.uniform(own[0], own[1], tokens),
            rng.uniform(spread[0], spread[1], tokens),
            float(rng.uniform(finger[0], finger[1])),
            config.centre * layout.radii[:, None] * around,
        )

    def _seen(self) -> Arrays:
        return {"corners": self._shown.copy(), "goals": self.goals.copy()}
