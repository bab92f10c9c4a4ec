"""TangramEnv: one tangram world as a gymnasium goal environment."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from tangram_core.arrays import Floats, Pixels
from tangram_core.errors import ConfigError
from tangram_sim.config import RewardConfig
from tangram_sim.table import SQUARE_SCALE, Observation, Table


class TangramEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """Move tokens onto their targets.

    Observations are a dict of float64 vectors: `achieved_goal` and `desired_goal` are the corners
    of the tokens and of the targets, (2V,); `observation` is the tokens' corners and one flag per
    token that is placed, (2V + K,), with the noise of `sim.corner_noise`. An episode has
    K * actions_per_token steps. It is terminated by the last of them if all tokens are placed, and
    truncated if some are left, as refused actions used up their steps, and where a lone token has
    several actions: that is a time limit, after which it could go on.

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
        self._table = Table(1, shapes, scale, reward, success_overlap, render_size, horizon, **sim)
        self.batch = self._table.batch
        self.layout, self.sim = self.batch.layout, self.batch.sim
        self.action_space = self._table.action_space
        self.observation_space = self._table.observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; a seed fixes this one and all that follow; SamplingError: no room."""
        super().reset(seed=seed, options=options)
        self._table.reset([self.np_random])
        return self._observation(), {}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Play one action of shape (A,)."""
        result = self._table.step(np.asarray(action, dtype=np.float64)[None])
        terminated, truncated = self._table.ends(result)
        return (
            self._observation(),
            float(result.rewards[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            self._table.info(result, 0),
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
        return None if self.render_mode is None else self._table.picture(0)

    def close(self) -> None:
        """Free the engine."""
        self.batch.close()

    def _observation(self) -> Observation:
        return {name: entry[0] for name, entry in self._table.observations().items()}


def check_render_mode(given: str | None) -> None:
    """Raise ConfigError for what is no render mode."""
    if given not in (None, "rgb_array"):
        raise ConfigError(f"render_mode must be None or rgb_array, got '{given}'")
