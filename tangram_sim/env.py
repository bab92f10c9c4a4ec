"""TangramEnv: one tangram world as a gymnasium goal environment."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box, Dict

from tangram_core.arrays import Floats, Pixels
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


class TangramEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """Move tokens onto their targets.

    Observations are a dict of float64 vectors: `achieved_goal` and `desired_goal` are the corners
    of the tokens and of the targets, (2V,); `observation` is the tokens' corners and one flag per
    token that is placed, (2V + K,). An episode has K * actions_per_token steps. It is terminated by
    the last of them if all tokens are placed, and truncated if some are left, as refused actions
    used up their steps, and where a lone token has several actions: that is a time limit, after
    which it could go on.

    Actions are those of `BatchedEnv`, entries in [-1, 1]: which token (with several), flip (with
    `allow_flip`: above 0 turns a token over that is not its own mirror image), then x, y and
    angular velocity. The corners of a token that lies on its other side run clockwise.

    `info` has `overlap` (raw, in [0, 1]), `is_success` (overlap of at least `success_overlap`),
    `refused` with the reason when the action was refused, `blocked` with the reason when its token
    could not be set down, and `reward_camera` (Eq. 14 from the pictures) with the camera on.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 - as gymnasium has it

    def __init__(
        self,
        shapes: Sequence[Any] = ("square",),
        scale: float = SQUARE_SCALE,
        reward: str | RewardConfig = "overlap",
        success_overlap: float = 0.95,
        render_mode: str | None = None,
        render_size: int = 240,
        horizon: int | None = None,
        **sim: Any,
    ) -> None:
        """Make the world.

        Args:
            shapes: see `TokensConfig`.
            scale: see `TokensConfig`; the default makes the square's side 0.4.
            reward: the name of a reward, or its whole configuration.
            success_overlap: raw overlap from which an episode counts as a success.
            render_mode: None or rgb_array.
            render_size: side of the rendered picture in pixels.
            horizon: steps that an episode has. An id has it, as its time limit does not change
                with other settings: those that would make longer or shorter episodes are refused.
            **sim: the fields of `SimConfig`, such as backend="kinematic".

        Raises:
            ConfigError: a setting that cannot work.
        """
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self.layout = make_layout(TokensConfig(tuple(shapes), scale))
        self.sim = _sim_config(sim)
        check_targets(self.layout, self.sim)
        check_range("success_overlap", success_overlap, 0.0, 1.0)
        check_range("render_size", render_size, 1, MAX_SIDE)
        steps = steps_of(self.layout.tokens, self.sim)
        if horizon not in (None, steps):
            raise ConfigError(
                f"an episode of these settings has {steps} steps, and the id's time limit is "
                f"{horizon}: give horizon={steps} and max_episode_steps={steps}, too, or keep to "
                "the id's number of tokens and actions_per_token"
            )
        paid = reward if isinstance(reward, RewardConfig) else RewardConfig(name=reward)
        self.batch = batch = BatchedEnv(self.layout, self.sim, paid, 1)
        self._success_overlap, self._render_size = success_overlap, render_size
        self._moved: int | None = None
        self.action_space = Box(-1.0, 1.0, (batch.action_size,), np.float32)
        goal = np.full(2 * self.layout.corner_count, batch.bound)
        flags = np.ones(self.layout.tokens)
        low, high = np.concatenate([-goal, 0.0 * flags]), np.concatenate([goal, flags])
        self.observation_space = Dict(
            {
                "observation": Box(low, high, dtype=np.float64),
                "achieved_goal": Box(-goal, goal, dtype=np.float64),
                "desired_goal": Box(-goal, goal, dtype=np.float64),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; a seed fixes this one and all that follow; SamplingError: no room."""
        super().reset(seed=seed, options=options)
        self.batch.reset([self.np_random])
        self._moved = None
        return self._observation(), {}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Play one action of shape (A,)."""
        given = np.asarray(action, dtype=np.float64)[None]
        result = self.batch.step(given)
        self._moved, placed = int(result.tokens[0]), bool(self.batch.placed.all())
        named = int(chosen_tokens(given, self.layout.tokens)[0])
        ended = bool(result.done)
        return (
            self._observation(),
            float(result.rewards[0]),
            ended and placed,
            ended and not placed,
            self._info(result, named),
        )

    def compute_reward(self, achieved_goal: Floats, desired_goal: Floats, info: Any) -> Any:  # noqa: ARG002 - goal environments have it
        """The reward of any achieved for any desired goal, as hindsight needs it.

        Args:
            achieved_goal: (2V,) or (B, 2V).
            desired_goal: the same shape.
            info: not used.

        Returns:
            A float, or (B,). With the camera as the reward's source this is the same measure on
            exact polygons, for goals that were never photographed.
        """
        corners = (-1, self.layout.corner_count, 2)
        achieved = np.asarray(achieved_goal, dtype=np.float64)
        desired = np.asarray(desired_goal, dtype=np.float64)
        rewards = self.batch.reward_fn(achieved.reshape(corners), desired.reshape(corners))
        return float(rewards[0]) if achieved.ndim == 1 else rewards

    def render(self) -> Pixels | None:
        """The scene as (size, size, 3), the last mover marked; None without a render mode."""
        if self.render_mode is None:
            return None
        scene = (self.batch.corners[0], self.batch.goals[0], self._render_size, self._moved)
        return np.asarray(draw_scene(self.layout, self.sim.arena, *scene), np.uint8)

    def close(self) -> None:
        """Free the engine."""
        self.batch.close()

    def _observation(self) -> Observation:
        achieved = self.batch.seen.ravel()
        return {
            "observation": np.concatenate([achieved, self.batch.placed[0]]),
            "achieved_goal": achieved.copy(),
            "desired_goal": self.batch.seen_goals.ravel().copy(),
        }

    def _info(self, result: StepResult, named: int) -> dict[str, Any]:
        """What is told of a step that named a token."""
        share = float(result.overlap[0])
        info: dict[str, Any] = {"overlap": share, "is_success": share >= self._success_overlap}
        if result.camera_rewards is not None:
            info["reward_camera"] = float(result.camera_rewards[0])
        if result.refused[0]:
            count = self.sim.actions_per_token
            info["refused"] = f"token {named} is placed already: it had its {count} actions"
        if result.blocked[0]:
            info["blocked"] = (
                f"token {self._moved} would lie on others by {result.covered[0]:.3%} of its area, "
                f"at most {MAX_OVERLAP:.3%} allowed: set it down where there is room"
            )
        return info


def _sim_config(settings: dict[str, Any]) -> SimConfig:
    known = [field.name for field in fields(SimConfig)]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise ConfigError(
            f"unknown setting '{unknown[0]}' of the environment: besides shapes, scale and reward "
            f"there are {', '.join(known)}"
        )
    return SimConfig(**settings)


def check_render_mode(given: str | None) -> None:
    """Raise ConfigError for what is no render mode."""
    if given not in (None, "rgb_array"):
        raise ConfigError(f"render_mode must be None or rgb_array, got '{given}'")
