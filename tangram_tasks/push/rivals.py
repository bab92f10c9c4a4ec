"""Planners that learn nothing: they try pushes in an engine of their own, and play the best.

Legend: B environments, K tokens, V corners, n candidates.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_sim.world.pushing import PushTable, Unknowns
from tangram_tasks.push.places import errors, on_table, push_of

if TYPE_CHECKING:
    from tangram_tasks.push.env import PushEnv
    from tangram_tasks.push.task import Push


@dataclass(frozen=True)
class Search:
    """How a planner searches.

    Attributes:
        pushes: looked ahead.
        tries: sequences of pushes in a round.
        rounds: each but the first draws around the best of the one before (cross-entropy method).
        elite: of them that the next round is drawn around.
        told: whether it knows friction and centres of mass; else it takes the middle of them.
        wrong: factor by which what it knows of the finger's friction is off.
    """

    pushes: int = 1
    tries: int = 64
    rounds: int = 1
    elite: int = 8
    told: bool = False
    wrong: float = 1.0


class Planner:
    """Chooses by trying pushes in the true engine."""

    def __init__(self, task: "Push", env: "PushEnv", search: Search) -> None:
        self._task, self._env, self._search = task, env, search
        self._table = PushTable(task.layout, task.config.finger)

    def __call__(self, seen: Arrays, past: History, generators: Generators) -> Singles:  # noqa: ARG002
        """(B, 4) the first push of the best sequence."""
        rows = zip(seen["corners"], seen["goals"], generators, strict=True)
        return np.stack([self._best(b, *row) for b, row in enumerate(rows)]).astype(np.float32)

    def _best(self, b: int, corners: Floats, goals: Floats, rng: np.random.Generator) -> Floats:
        task, search, layout = self._task, self._search, self._task.layout
        goals = np.asarray(goals, np.float64)
        present, poses = on_table(goals, layout), layout.poses(np.asarray(corners, np.float64))
        placed = task.placed(corners[None], goals[None])[0]
        self._table.place(poses, present, self._unknowns(b))
        left = np.flatnonzero(present & ~placed)
        if not len(left):
            return np.zeros(4)
        tokens = left if search.pushes == 1 else np.flatnonzero(present)
        best, least = np.zeros(4), np.inf
        mean, deviation = np.zeros((search.pushes, 3)), np.ones((search.pushes, 3))
        chances = np.full((search.pushes, len(tokens)), 1.0 / len(tokens))
        for number in range(search.rounds):
            drawn = rng.uniform(-1.0, 1.0, (search.tries, search.pushes, 3))
            if number:
                normal = rng.standard_normal(drawn.shape)
                drawn = (mean + deviation * normal + 1.0) % 2.0 - 1.0
            which = np.stack(
                [rng.choice(len(tokens), search.tries, p=chance) for chance in chances], axis=1
            )
            named = (tokens[which] + 0.5) / layout.tokens * 2.0 - 1.0
            actions = np.concatenate([named[..., None], drawn], axis=-1)
            costs = np.array([self._cost(poses, present, goals, one) for one in actions])
            order = np.argsort(costs)
            if costs[order[0]] < least:
                best, least = actions[order[0], 0], float(costs[order[0]])
            elite = order[: search.elite]
            mean, deviation = drawn[elite].mean(axis=0), drawn[elite].std(axis=0) + 0.05
            same = which[elite][..., None] == np.arange(len(tokens))
            chances = 0.8 * same.mean(axis=0) + 0.2 / len(tokens)
        return best

    def _cost(self, poses: Floats, present: Bools, goals: Floats, actions: Floats) -> float:
        """Of a sequence of pushes (pushes, 4): what is left to go, in tolerances."""
        task, layout = self._task, self._task.layout
        self._table.lay(poses)
        now = poses
        spent = 0.0
        for number, action in enumerate(actions):
            corners = self._env.corners_of(now, present)
            push = push_of(layout, corners, action, task.config.finger, task.config.longest)
            if push.refused:
                spent += 1.0
                continue
            self._table.push(push.begin, push.way)
            now = self._table.poses()
            left = self._left(now, present, goals)
            if left == 0.0:
                return float(number)
        return self._left(now, present, goals) + spent + len(actions)

    def _left(self, poses: Floats, present: Bools, goals: Floats) -> float:
        task = self._task
        corners = self._env.corners_of(poses, present)
        distance, turn = errors(task.layout, corners[None], goals[None])
        if task.placed(corners[None], goals[None]).all():
            return 0.0
        far = np.hypot(distance[0] / task.config.within, turn[0] / task.config.turned)
        return float((far * present).sum())

    def _unknowns(self, b: int) -> Unknowns:
        if not self._search.told:
            return self._env.middle
        known = self._env.unknowns[b]
        return replace(known, finger=known.finger * self._search.wrong)
