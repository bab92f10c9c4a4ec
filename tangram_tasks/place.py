"""Tokens are moved onto their target: one to seven of them, lifted or slid, by PyBullet or exactly.

Legend: K tokens, V corners.
"""

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.spec import Array, EpisodeSpec
from tangram_core.task import Json, Task
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.episodes import spec_of
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tangram_sim.motion.actions import action_size, corner_bound, goal_rows, horizon
from tangram_sim.rewards import RewardFn, check_reward, make_reward, pinned, reward_identity
from tangram_sim.tasks.targets import check_targets
from tangram_sim.world.world import check_room, check_shown, check_world


@dataclass(frozen=True)
class Place(Task):
    """The paper's task, and all of the tangram: every piece of the target is seen."""

    sections: ClassVar = {"tokens": TokensConfig, "sim": SimConfig, "reward": RewardConfig}
    waits: ClassVar = "in one, pictures must show all tokens: larger sim.pixels help"
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
        """The token set's fixed structure."""
        return make_layout(self.tokens)

    @cached_property
    def reward_of(self) -> RewardFn:
        """(achieved corners (n, V, 2), desired ones) -> rewards (n,)."""
        return make_reward(self.reward, self.layout, self.sim)

    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """(n,) of corners (n, V, 2)."""
        return self.reward_of(achieved.astype(np.float64), desired.astype(np.float64))

    @property
    def horizon(self) -> int:
        """T: actions in one episode."""
        return horizon(self.layout.tokens, self.sim)

    @property
    def goal_rows(self) -> int:
        """G: corners of a target as agents see it."""
        return goal_rows(self.layout, self.sim)

    @property
    def action_size(self) -> int:
        """A: x, y and angular velocity, with more than one token its number before them."""
        return action_size(self.layout.tokens, self.sim)

    @property
    def bound(self) -> float:
        """The largest |coordinate| that a corner can reach."""
        return corner_bound(self.layout.tokens, self.sim)

    @cached_property
    def spec(self) -> EpisodeSpec:
        """What its episodes are made of."""
        return spec_of(self.layout, self.sim, self.reward, self.outlines)

    def identity(self) -> Json:
        """Tokens by what makes them, a reward of one's own by its content."""
        return {
            "tokens": {"layout": self.layout.fingerprint()},
            "sim": asdict(self.sim),
            "reward": reward_identity(self.reward),
        }

    def check(self, *, plays: bool) -> None:
        """Refuse what no world could play, or no agent is shown."""
        check_shown(self.sim, self.outlines)
        (check_world if plays else check_room)(self.layout, self.sim)
        check_reward(self.reward, self.layout, self.sim)

    def pinned(self) -> Self:
        """With a reward of one's own named by its content, so that it holds elsewhere, too."""
        return replace(self, reward=pinned(self.reward))

    def with_sim(self, **values: Any) -> Self:
        """In another world."""
        return replace(self, sim=replace(self.sim, **values))

    def facts(self) -> Json:
        """Tokens, actions, reward and engine."""
        return {
            "tokens": [shape.name for shape in self.layout.shapes],
            "actions_per_token": self.sim.actions_per_token,
            "reward": self.reward.name,
            "backend": self.sim.backend,
        }
