"""A task on a line, whose numbers can be checked by hand."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from tangram_core.scores import Score
from tangram_core.spec import EpisodeSpec, Field
from tangram_core.task import Env, Task


@dataclass(frozen=True)
class Line(Task):
    """Four steps; a goal is reached where the place is the goal, and that ends it."""

    scores: ClassVar = (Score("success", "reached"),)
    spec = EpisodeSpec(
        4,
        1,
        (
            Field("place", (1,), -1e4, 1e4),
            Field("time", (), 0, 4),
            Field("goal", (1,), -1e4, 1e4, "episode"),
        ),
        achieved="place",
        desired="goal",
        rewards=(-1.0, 0.0),
    )

    def rewards(self, achieved: Any, desired: Any) -> Any:
        return -1.0 * (achieved != desired)[:, 0]

    def ended(self, achieved: Any, desired: Any, recorded: Any) -> Any:
        return (achieved == desired)[:, 0]

    def make(self, count: int, purpose: str = "play") -> Env:
        raise NotImplementedError

    def score(self, played: Any) -> dict[str, float]:
        return {"success": float(np.mean(played.episodes.rewards[:, -1] == 0))}
