"""Task `place`: one to seven tokens are moved onto their target, by PyBullet or exactly.

Legend: K tokens, V corners.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from tangram_core.arrays import Floats, Pixels
from tangram_core.scores import Score
from tangram_core.spec import Array, EpisodeSpec
from tangram_core.task import Chooser, Env, Json, Played, Purpose, Task
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.episodes import spec_of
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tangram_sim.motion.actions import goal_rows
from tangram_sim.rewards import RewardFn, check_reward, make_reward, pinned, reward_identity
from tangram_sim.targets.targets import check_targets
from tangram_sim.world.world import check_room, check_shown, check_world

if TYPE_CHECKING:
    from tangram_tasks.env import PlaceEnv

PICTURES, PIXELS = 12, 216  # test episodes on a sheet, and the side of each
_REWARD, _COVERAGE = Score("mean_reward", "mean reward"), Score("coverage", "coverage")
_ERRORS = (
    Score("angle_error_deg_median", "angle error", 2, "°"),
    Score("position_error_median", "position error", 4),
    Score("angle_error_deg_p90", "angle error, 90th perc.", 2, "°"),
    Score("position_error_p90", "position error, 90th perc.", 4),
)
_MORE = (
    Score("mean_reward_camera", "mean reward, camera"),
    Score("mean_reward_dense", "mean reward of Eq. 15"),
    Score("mean_train_reward", "mean reward as trained on"),
    Score("coverage_p10", "coverage, 10th perc."),
)
ONE_TOKEN = (_REWARD, _COVERAGE, *_ERRORS, *_MORE)
SEVERAL = (
    _COVERAGE,
    Score("solved", "solved (95 % covered)"),
    Score("iou", "IoU"),
    *_ERRORS,
    _REWARD,
    *_MORE,
    Score("wrong", "pieces under another shape", 2),
    Score("doubly_used", "pieces under two tokens", 2),
    Score("refused", "actions refused", 2),
    Score("blocked", "tokens blocked", 2),
    Score("actions_used", "actions", 2),
)


@dataclass(frozen=True)
class Place(Task):
    """The paper's task, also for several tokens; agents see every piece of the target."""

    sections: ClassVar = {"tokens": TokensConfig, "sim": SimConfig, "reward": RewardConfig}
    agent: ClassVar = "tangram"
    waits: ClassVar = "its pictures must show all tokens: a larger sim.pixels helps"
    outlines: ClassVar[bool] = False  # whether goals are rows of the target's outline

    tokens: TokensConfig
    sim: SimConfig
    reward: RewardConfig

    def __post_init__(self) -> None:
        """Refuse targets that these tokens cannot form.

        Raises:
            ConfigError: names the setting and the remedy.
        """
        check_targets(self.layout, self.sim)

    @cached_property
    def layout(self) -> Layout:
        """The fixed geometry of the token set."""
        return make_layout(self.tokens)

    @cached_property
    def reward_of(self) -> RewardFn:
        """The reward function: achieved and desired corners (n, V, 2) -> rewards (n,)."""
        return make_reward(self.reward, self.layout, self.sim)

    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """Rewards (n,) of achieved and desired corners (n, V, 2)."""
        return self.reward_of(achieved.astype(np.float64), desired.astype(np.float64))

    @property
    def goal_rows(self) -> int:
        """Number of a target's corners that agents see (G)."""
        return goal_rows(self.layout, self.sim)

    @cached_property
    def spec(self) -> EpisodeSpec:
        """Names, shapes and dtypes of the arrays in an episode."""
        return spec_of(self.layout, self.sim, self.reward, self.outlines)

    def make(self, count: int, purpose: Purpose = "play") -> "PlaceEnv":
        """Make `count` worlds; see `PlaceEnv`."""
        from tangram_tasks.env import PlaceEnv  # noqa: PLC0415

        return PlaceEnv(self, count, purpose)

    @property
    def scores(self) -> tuple[Score, ...]:  # type: ignore[override]
        """Scores of the pose of one token, or of the coverage by several tokens."""
        return ONE_TOKEN if self.layout.tokens == 1 else SEVERAL

    def score(self, played: Played) -> dict[str, float]:
        """Compute the scores of played episodes; see `metrics.summarise`."""
        from tangram_tasks.metrics import summarise  # noqa: PLC0415  # scipy, which only scoring needs
        from tangram_tasks.played import Played as PlayedTokens  # noqa: PLC0415

        own = (self.reward.name, self.reward.source) != ("overlap", "polygon")
        return summarise(self.layout, self.sim, PlayedTokens.of(played), own, self.outlines)

    def draw(self, played: Played) -> Pixels:
        """Draw how the first episodes ended, each with its coverage."""
        from tangram_sim.drawing.scenes import episode_sheet  # noqa: PLC0415
        from tangram_tasks.played import Played as PlayedTokens  # noqa: PLC0415

        own = PlayedTokens.of(played)
        starts, ends, goals = (c[:PICTURES] for c in (own.starts, own.ends, own.goals))
        sheet = episode_sheet(self.layout, self.sim.arena, starts, ends, goals, 4, PIXELS)
        return np.asarray(sheet.convert("RGB"))

    def rivals(self) -> Mapping[str, Callable[[Env], Chooser]]:
        """The baselines by name, the strongest first; see `tangram_tasks.rivals.baselines`."""
        from tangram_tasks.rivals.baselines import (  # noqa: PLC0415
            exact_policy,
            position_policy,
            random_policy,
        )

        layout, sim = self.layout, self.sim
        found: dict[str, Callable[[Env], Chooser]] = {"exact": lambda _: exact_policy(layout, sim)}
        if layout.tokens == 1:
            found["position only"] = lambda _: position_policy(layout, sim)
        return found | {"random": lambda _: random_policy(layout, sim)}

    def identity(self) -> Json:
        """Token geometry, sim and reward, which must be equal on master and workers."""
        return {
            "tokens": {"layout": self.layout.fingerprint()},
            "sim": asdict(self.sim),
            "reward": reward_identity(self.reward),
        }

    def check(self, *, plays: bool) -> None:
        """Refuse settings that no world can play or no agent can observe.

        Raises:
            ConfigError: names the setting and the remedy.
            SamplingError: the tokens do not fit into the arena.
        """
        check_shown(self.sim, self.outlines)
        (check_world if plays else check_room)(self.layout, self.sim)
        check_reward(self.reward, self.layout, self.sim)

    def pinned(self) -> Self:
        """A copy that names a user's own reward by absolute path and hash of its file."""
        return replace(self, reward=pinned(self.reward))

    def with_sim(self, **values: Any) -> Self:
        """A copy with other values of `sim`."""
        return replace(self, sim=replace(self.sim, **values))

    def facts(self) -> Json:
        """Tokens, actions per token, reward and engine, for result.json."""
        return {
            "tokens": [shape.name for shape in self.layout.shapes],
            "actions_per_token": self.sim.actions_per_token,
            "reward": self.reward.name,
            "backend": self.sim.backend,
        }
