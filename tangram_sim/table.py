"""What gymnasium's environments, one or several in step, show of a batch."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Pixels
from tangram_core.errors import ConfigError
from tangram_core.settings import check_range
from tangram_sim.batch import BatchedEnv, StepResult
from tangram_sim.config import MAX_OVERLAP, RewardConfig, SimConfig
from tangram_sim.drawing.scenes import draw_scene
from tangram_sim.geometry.layout import TokensConfig, make_layout
from tangram_sim.motion.actions import chosen_tokens
from tangram_sim.motion.actions import horizon as steps_of
from tangram_sim.targets.targets import check_targets

Observation = dict[str, Any]  # of float64 vectors

MAX_SIDE = 4096  # of a picture, pixels
# The square tan has a quarter of the full square's diagonal as its side: this makes it 0.4.
SQUARE_SCALE = 0.8 * 2.0**0.5


class Table:
    """A batch with its spaces, observations, infos and pictures; see `TangramEnv`.

    Attributes:
        batch: what is played.
        action_space, observation_space: of one environment.
    """

    def __init__(
        self,
        count: int,
        shapes: Sequence[Any] = ("square",),
        scale: float = SQUARE_SCALE,
        reward: str | RewardConfig = "overlap",
        success_overlap: float = 0.95,
        render_size: int = 240,
        horizon: int | None = None,
        **sim: Any,
    ) -> None:
        layout = make_layout(TokensConfig(tuple(shapes), scale))
        config = _sim_config(sim)
        check_targets(layout, config)
        check_range("success_overlap", success_overlap, 0.0, 1.0)
        check_range("render_size", render_size, 1, MAX_SIDE)
        steps = steps_of(layout.tokens, config)
        if horizon not in (None, steps):
            raise ConfigError(
                f"an episode of these settings has {steps} steps, and the id's time limit is "
                f"{horizon}: give horizon={steps} and max_episode_steps={steps}, too, or keep to "
                "the id's number of tokens and actions_per_token"
            )
        paid = reward if isinstance(reward, RewardConfig) else RewardConfig(name=reward)
        self.batch = BatchedEnv(layout, config, paid, count)
        self._success_overlap = success_overlap
        self._render_size = render_size
        self._named: Ints = np.zeros(count, dtype=np.int64)
        self._moved: Ints | None = None
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.batch.action_size,), np.float32)
        self.observation_space = _observation_space(self.batch)

    def reset(self, generators: Sequence[np.random.Generator]) -> None:
        """Begin an episode in every environment; each has its own generator."""
        self.batch.reset(generators)
        self._moved = None

    def step(self, actions: Floats) -> StepResult:
        """Play one action (A,) in every environment."""
        result = self.batch.step(actions)
        self._named = chosen_tokens(actions, self.batch.layout.tokens)
        self._moved = result.tokens
        return result

    def ends(self, result: StepResult) -> tuple[Bools, Bools]:
        """(B,) which episodes end as all tokens are placed, and which as their steps ran out."""
        placed: Bools = np.asarray(self.batch.placed.all(axis=1))
        return placed & result.done, ~placed & result.done

    def observations(self) -> Observation:
        """Of all environments: each entry (B, n), arrays of their own."""
        batch = self.batch
        achieved = batch.seen.reshape(batch.count, -1)
        return {
            "observation": np.concatenate([achieved, batch.placed], axis=1),
            "achieved_goal": achieved.copy(),
            "desired_goal": batch.seen_goals.reshape(batch.count, -1).copy(),
        }

    def info(self, result: StepResult, row: int) -> dict[str, Any]:
        """What is told of one environment's step."""
        sim = self.batch.sim
        share = float(result.overlap[row])
        info: dict[str, Any] = {"overlap": share, "is_success": share >= self._success_overlap}
        if result.camera_rewards is not None:
            info["reward_camera"] = float(result.camera_rewards[row])
        if result.refused[row]:
            info["refused"] = (
                f"token {self._named[row]} is placed already: it had its "
                f"{sim.actions_per_token} actions"
            )
        if result.blocked[row]:
            info["blocked"] = (
                f"token {result.tokens[row]} would lie on others by {result.covered[row]:.3%} of "
                f"its area, at most {MAX_OVERLAP:.3%} allowed: set it down where there is "
                "room"
            )
        return info

    def picture(self, row: int) -> Pixels:
        """One environment's scene as (size, size, 3), the token that moved last marked."""
        batch = self.batch
        image = draw_scene(
            batch.layout,
            batch.sim.arena,
            batch.corners[row],
            batch.goals[row],
            self._render_size,
            None if self._moved is None else int(self._moved[row]),
        )
        return np.asarray(image, dtype=np.uint8)


def _sim_config(settings: dict[str, Any]) -> SimConfig:
    known = [field.name for field in fields(SimConfig)]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise ConfigError(
            f"unknown setting '{unknown[0]}' of the environment: besides shapes, scale and reward "
            f"there are {', '.join(known)}"
        )
    return SimConfig(**settings)


def _observation_space(batch: BatchedEnv) -> gymnasium.spaces.Dict:
    corners = 2 * batch.layout.corner_count
    goal = gymnasium.spaces.Box(-batch.bound, batch.bound, (corners,), np.float64)
    low = np.concatenate([goal.low, np.zeros(batch.layout.tokens)])
    high = np.concatenate([goal.high, np.ones(batch.layout.tokens)])
    return gymnasium.spaces.Dict(
        {
            "observation": gymnasium.spaces.Box(low, high, dtype=np.float64),
            "achieved_goal": goal,
            "desired_goal": gymnasium.spaces.Box(-batch.bound, batch.bound, (corners,), np.float64),
        }
    )
