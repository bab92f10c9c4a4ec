"""TangramEnv: one tangram world as a gymnasium goal environment."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from tangram_sim.actions import chosen_tokens
from tangram_sim.arrays import Floats, Pixels
from tangram_sim.batch import BatchedEnv, StepResult
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.drawing import draw_scene
from tangram_sim.errors import ConfigError
from tangram_sim.layout import TokensConfig, make_layout
from tangram_sim.targets import check_targets

Observation = dict[str, Any]  # of float64 vectors

# The square tan has a quarter of the full square's diagonal as its side: this makes it 0.4.
SQUARE_SCALE = 0.8 * 2.0**0.5


class TangramEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """Move tokens onto their targets.

    Observations are a dict of float64 vectors: `achieved_goal` and `desired_goal` are the corners
    of the tokens and of the targets, (2V,); `observation` is the tokens' corners and one flag per
    token that is placed, (2V + K,), with the noise of `sim.corner_noise`. An episode ends after
    K * actions_per_token steps.

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
            **sim: the fields of `SimConfig`, such as backend="kinematic".

        Raises:
            ConfigError: a setting that cannot work.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"render_mode must be None or rgb_array, got '{render_mode}'")
        self.render_mode = render_mode
        self.layout = make_layout(TokensConfig(tuple(shapes), scale))
        self.sim = _sim_config(sim)
        check_targets(self.layout, self.sim)
        config = reward if isinstance(reward, RewardConfig) else RewardConfig(name=reward)
        self.batch = BatchedEnv(self.layout, self.sim, config)
        self._success_overlap = success_overlap
        self._render_size = render_size
        self._active: int | None = None
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.batch.action_size,), np.float32)
        self.observation_space = _observation_space(self.batch)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; a seed fixes this one and all that follow.

        Raises:
            SamplingError: no layout without overlap was found.
        """
        super().reset(seed=seed, options=options)
        self.batch.reset([self.np_random])
        self._active = None
        return self._observation(), {}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Play one action of shape (A,)."""
        actions = np.asarray(action, dtype=np.float64)[None]
        result = self.batch.step(actions)
        self._active = int(chosen_tokens(actions, self.layout.tokens)[0])
        reward = float(result.rewards[0])
        return self._observation(), reward, result.done, False, self._info(result)

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

    def state_matrix(self) -> Floats:
        """The paper's state (Sec. IV-A): nodes and adjacency stacked, (N, 4 + N)."""
        batch = self.batch
        return self.layout.state_matrix(batch.seen[0], batch.placed[0], batch.seen_goals[0])

    def render(self) -> Pixels | None:
        """The scene as (size, size, 3), the token that moved last marked; None without a mode."""
        if self.render_mode is None:
            return None
        batch = self.batch
        image = draw_scene(
            self.layout,
            self.sim.arena,
            batch.corners[0],
            batch.goals[0],
            self._render_size,
            self._active,
        )
        return np.asarray(image, dtype=np.uint8)

    def close(self) -> None:
        """Free the engine."""
        self.batch.close()

    def _observation(self) -> Observation:
        achieved = self.batch.seen[0].ravel()
        return {
            "observation": np.concatenate([achieved, self.batch.placed[0]]),
            "achieved_goal": achieved.copy(),
            "desired_goal": self.batch.seen_goals[0].flatten(),
        }

    def _info(self, result: StepResult) -> dict[str, Any]:
        share = float(result.overlap[0])
        info: dict[str, Any] = {"overlap": share, "is_success": share >= self._success_overlap}
        if result.camera_rewards is not None:
            info["reward_camera"] = float(result.camera_rewards[0])
        if result.refused[0]:
            info["refused"] = (
                f"token {self._active} is placed already: it had its "
                f"{self.sim.actions_per_token} actions"
            )
        if result.blocked[0]:
            info["blocked"] = (
                f"token {self._active} would lie on others by {result.covered[0]:.3%} of its area, "
                f"at most {self.sim.max_overlap:.3%} allowed: set it down where there is room, or "
                "raise max_overlap"
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
