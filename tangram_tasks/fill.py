"""Task `fill`: tokens fill an outline whose pieces are hidden."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_core.scores import Score
from tangram_core.settings import refuse_ignored, told
from tangram_core.spec import Array
from tangram_core.task import Chooser, Env, Played
from tangram_sim.config import SILHOUETTE, RewardConfig
from tangram_sim.rewards import scaled_overlap
from tangram_tasks.place import SEVERAL, Place

_AREAS = (
    *("coverage", "solved", "iou", "mean_reward", "coverage_p10"),
    *("blocked", "refused", "actions_used"),
)
_SOLVED = Score("solved", "solved (IoU 0.95)")


@dataclass(frozen=True)
class Fill(Place):
    """Each token starts outside of the outline and is set down once."""

    agent: ClassVar[str] = "outline"
    outlines: ClassVar[bool] = True

    @property
    def scores(self) -> tuple[Score, ...]:  # type: ignore[override]
        """Scores of areas only: any dissection of the outline counts."""
        own = {score.name: score for score in SEVERAL} | {_SOLVED.name: _SOLVED}
        return tuple(own[name] for name in _AREAS)

    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """Rewards (n,) by Eq. 14, of corners (n, V, 2) and outlines (n, G, 2)."""
        # Imported here: shapely loads slowly, and workers do not need it.
        import shapely  # noqa: PLC0415

        from tangram_sim.geometry.overlap import outlines  # noqa: PLC0415
        from tangram_sim.geometry.rings import as_area  # noqa: PLC0415

        tokens = shapely.polygons(outlines(achieved.astype(np.float64), self.layout))
        areas = np.array([as_area(rows) for rows in desired])
        shared = shapely.area(shapely.intersection(shapely.union_all(tokens, axis=1), areas))
        return scaled_overlap(np.clip(shared / self.layout.areas.sum(), 0.0, 1.0))

    def score(self, played: Played) -> dict[str, float]:
        """Compute the scores of areas; a figure is solved if its IoU is at least `SOLVED`."""
        every = super().score(played)
        return {name: every[name] for name in _AREAS}

    def rivals(self) -> Mapping[str, Callable[[Env], Chooser]]:
        """A search, and random play; the formula would need the hidden pieces."""
        from tangram_tasks.rivals.search import search_policy  # noqa: PLC0415

        found: dict[str, Callable[[Env], Chooser]] = {
            "search": lambda _: search_policy(self.layout, self.sim)
        }
        return found | {"random": super().rivals()["random"]}

    def __post_init__(self) -> None:
        """Refuse settings that do not move each token exactly once, from outside.

        Raises:
            ConfigError: names the setting and the remedy.
        """
        if self.layout.tokens == 1:  # before the checks of `Place`, whose remedies lead here
            raise ConfigError(
                f"tokens={self.layout.shapes[0].name}: task=fill needs a set of several tokens: "
                "set tokens=tangram7, or task=place"
            )
        super().__post_init__()
        sim = self.sim
        if sim.observe != SILHOUETTE:
            raise ConfigError(
                f"task=fill shows outlines, got sim.observe={sim.observe}: set sim=silhouette, or "
                "task=place"
            )
        wanted: dict[str, object] = {
            "starts": "outside",
            "actions_per_token": 1,
            "allow_flip": self.layout.any_chiral or sim.allow_flip,
        }
        for name, value in wanted.items():
            given = getattr(sim, name)
            if given != value:
                raise ConfigError(
                    f"sim.{name}={told(given)}: in task=fill each token is set down once, "
                    f"from outside: set sim.{name}={told(value)}"
                )
        for own in fields(RewardConfig):
            if getattr(self.reward, own.name) != own.default:
                given = f"reward.{own.name}={told(getattr(self.reward, own.name))}"
                refuse_ignored(given, "task=fill, which always pays for coverage", "set task=place")
