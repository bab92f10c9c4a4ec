"""A task of one's own: a point on a square must come to a place.

Train it with: tangram-train task=docs/examples/point.py:Point
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tangram_core.scores import Score
from tangram_core.settings import Settings, setting
from tangram_core.spec import EpisodeSpec, Field
from tangram_core.task import Env, Step, Task


@dataclass(frozen=True)
class PointConfig(Settings, section="task"):
    reach: float = setting(0.1, "distance at which the place is reached", low=0)
    stride: float = setting(0.2, "the longest way of one action, in each direction", low=0)


class Points(Env):
    def __init__(self, task, count):
        self.task, self.count = task, count

    def reset(self, generators):
        drawn = np.stack([one.uniform(-1, 1, (2, 2)) for one in generators])
        self.place, self.goal = drawn[:, 0], drawn[:, 1]
        return self.seen()

    def step(self, actions):
        self.place = np.clip(self.place + self.task.config.stride * actions, -1, 1)
        seen = self.seen()
        rewards = self.task.rewards(seen["place"], seen["goal"])
        return Step(seen, rewards, np.zeros(self.count, bool))

    def seen(self):
        return {"place": self.place.astype("f4"), "goal": self.goal.astype("f4")}


@dataclass(frozen=True)
class Point(Task):
    sections: ClassVar = {"task": PointConfig}
    scores: ClassVar = (Score("success", "in its place at the end, share"),)
    config: PointConfig = PointConfig()
    fields = (Field("place", (2,), -1.0, 1.0), Field("goal", (2,), -1.0, 1.0, "episode"))
    spec = EpisodeSpec(20, 2, fields, achieved="place", desired="goal", rewards=(-1.0, 0.0))

    def rewards(self, achieved, desired):
        return -1.0 * (np.linalg.norm(achieved - desired, axis=-1) > self.config.reach)

    def make(self, count, purpose="play"):
        return Points(self, count)

    def score(self, played):
        return {"success": float((played.episodes.rewards[:, -1] == 0).mean())}
