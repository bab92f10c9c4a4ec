"""The table as a goal environment of gymnasium: after `import tangram_tasks.push.gym_env`.

`gymnasium.make("Push-v0")` is one square, `Push2-v0` a square beside a triangle, `Push7-v0` the
seven tans.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from tangram_core.arrays import Floats, Pixels, Singles
from tangram_core.errors import ConfigError
from tangram_core.settings import check_range
from tangram_core.setup import from_mapping
from tangram_core.spec import Array
from tangram_sim.drawing.scenes import draw_scene
from tangram_sim.env import MAX_SIDE, Observation, check_render_mode
from tangram_sim.geometry.layout import TokensConfig
from tangram_sim.puzzles.assembly import COUNTS
from tangram_tasks.push.env import PushEnv
from tangram_tasks.push.places import ARENA
from tangram_tasks.push.task import FURTHEST, PER_TOKEN, Push, PushConfig

PAIR, SCALE = ("square", "small_triangle"), 0.8 * 2**0.5
SEVEN = tuple(name for name, count in COUNTS.items() for _ in range(count))
IDS: dict[str, tuple[tuple[str, ...], float]] = {
    "Push-v0": (PAIR[:1], SCALE),
    "Push2-v0": (PAIR, SCALE),
    "Push7-v0": (SEVEN, 0.6),
}


class PushGoalEnv(gymnasium.Env[Observation, Singles]):
    """One table. Observations are corners (2V,), as is what is achieved; goals are their places.

    An episode terminates when all tokens are in place; an id has eight pushes a token. `info`
    has `is_success`, and `refused` with the reason where the finger could not come down.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 - as gymnasium has it

    def __init__(
        self,
        shapes: tuple[str, ...] = PAIR[:1],
        scale: float = SCALE,
        render_mode: str | None = None,
        render_size: int = 240,
        horizon: int | None = None,
        **settings: Any,
    ) -> None:
        """Set up the table.

        Args:
            shapes: of the tokens.
            scale: side of the full square that they are cut from, arena units.
            render_mode: None or rgb_array.
            render_size: side of a picture, pixels.
            horizon: pushes of an episode. An id has it, as its time limit does not change with
                other settings: those that would make longer or shorter episodes are refused.
            **settings: the fields of `PushConfig`.

        Raises:
            ConfigError: a setting that cannot work.
        """
        check_render_mode(render_mode)
        check_range("render_size", render_size, 1, MAX_SIDE)
        config = from_mapping(PushConfig, settings)
        self.task = Push(TokensConfig(tuple(shapes), scale), config)
        self.task.check(plays=True)
        pushes = self.task.spec.horizon
        if horizon not in (None, pushes):
            raise ConfigError(
                f"an episode of these settings has {pushes} pushes, and the id's time limit is "
                f"{horizon}: give horizon={pushes} and max_episode_steps={pushes}, too"
            )
        self.render_mode, self._size = render_mode, render_size
        self._env = PushEnv(self.task, 1)
        self.action_space = spaces.Box(-1.0, 1.0, (self.task.spec.action_size,), np.float32)
        box = spaces.Box(-FURTHEST, FURTHEST, (2 * self.task.layout.corner_count,), np.float64)
        names = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict(dict.fromkeys(names, box))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; a seed fixes this one and all that follow."""
        super().reset(seed=seed, options=options)
        self._env.reset([self.np_random])
        return self._seen(), {}

    def step(self, action: Singles) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Push once, by an action (4,), cut to [-1, 1]."""
        step = self._env.step(np.clip(np.asarray(action, np.float32), -1.0, 1.0)[None])
        ended = bool(step.terminated[0])
        info: dict[str, Any] = {"is_success": ended}
        if self._env.refused[0]:
            info["refused"] = self._env.refused[0]
        return self._seen(), float(step.rewards[0]), ended, False, info

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:  # noqa: ARG002 - goal environments have it
        """Of goals (2V,) a float, of (n, 2V) their rewards (n,)."""
        achieved, desired = np.asarray(achieved_goal), np.asarray(desired_goal)
        rows = (-1, self.task.layout.corner_count, 2)
        rewards: Floats = self.task.rewards(achieved.reshape(rows), desired.reshape(rows))
        return float(rewards[0]) if achieved.ndim == 1 else rewards

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:
        """Whether all are in place, of one goal or of rows of them."""
        reward = self.compute_reward(achieved_goal, desired_goal, info)
        return reward == 0.0

    def compute_truncated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> bool:  # noqa: ARG002
        """Never: the limit is gymnasium's."""
        return False

    def render(self) -> Pixels | None:
        """The table from above, (size, size, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        scene = (self._env.corners[0], self._env.goals[0], self._size, None)
        return np.asarray(draw_scene(self.task.layout, ARENA, *scene), np.uint8)

    def close(self) -> None:
        """End the engine's client."""
        self._env.close()

    def _seen(self) -> Observation:
        corners = self._env.corners[0].ravel()
        goals = self._env.goals[0].ravel().copy()
        return {
            "observation": corners.copy(),
            "achieved_goal": corners.copy(),
            "desired_goal": goals,
        }


for _name, (_shapes, _scale) in IDS.items():
    if _name not in gymnasium.registry:  # else the module was loaded again
        gymnasium.register(
            _name,
            PushGoalEnv,
            max_episode_steps=PER_TOKEN * len(_shapes),
            kwargs={"shapes": _shapes, "scale": _scale, "horizon": PER_TOKEN * len(_shapes)},
        )
