"""Any task as a goal environment of gymnasium; `register.py` has the ids.

Legend: A entries of an action, n goals.
"""

import math
from collections.abc import Sequence
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces

from tangram_core.arrays import Bools, Floats, Pixels, Singles
from tangram_core.errors import ConfigError
from tangram_core.settings import check_range
from tangram_core.setup import from_mapping
from tangram_core.spec import Array, Arrays
from tangram_core.task import Purpose, Task
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import TokensConfig
from tangram_tasks.place import Place
from tangram_tasks.push.task import Push, PushConfig

Observation = dict[str, Any]  # of float64 vectors

MAX_SIDE = 4096  # pixels, of a rendered picture
# The side of the square tan is a quarter of the full square's diagonal; this makes it 0.4.
SQUARE_SCALE = 0.8 * 2.0**0.5


class TaskEnv(gymnasium.Env[Observation, Singles]):
    """A gymnasium goal environment of one task.

    Observations are a dict of float64 vectors: `achieved_goal`, `desired_goal` and `observation`.
    The last one concatenates all other fields of the task's spec. Actions are clipped to [-1, 1].
    An episode that does not terminate is truncated after `task.spec.horizon` steps. `info` has
    `is_success` and the entries of `Env.told`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 - as gymnasium has it

    def __init__(
        self,
        task: Task,
        render_mode: str | None = None,
        render_size: int = 240,
        purpose: Purpose = "play",
    ) -> None:
        """Make the environment.

        Args:
            task: the task to play, such as `load_run(...).setup.task`.
            render_mode: None or rgb_array.
            render_size: side of the rendered picture in pixels.
            purpose: test plays the episodes of tests: without `task.fewer`, and with the camera.

        Raises:
            ConfigError: an argument is out of its range, or the task cannot be played.
            SamplingError: the tokens do not fit.
        """
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"render_mode must be None or rgb_array, got '{render_mode}'")
        if not isinstance(render_size, int | np.integer):
            raise ConfigError(f"render_size must be a whole number, got {render_size!r}: set 240")
        check_range("render_size", render_size, 1, MAX_SIDE)
        task.check(plays=True)
        self.task, self.render_mode, self._size = task, render_mode, render_size
        self._env, spec = task.make(1, purpose), task.spec
        self._steps, self._ended = spec.horizon, False  # no episode yet
        self._fields = [one for one in spec.fields if one.name != spec.desired]
        self.action_space = spaces.Box(-1.0, 1.0, (spec.action_size,), np.float32)

        def box(*names: str) -> spaces.Box:
            fields = [spec.field(name) for name in names]
            sizes = [math.prod(one.shape) for one in fields]
            low, high = np.repeat([(one.low, one.high) for one in fields], sizes, axis=0).T
            return spaces.Box(low, high, dtype=np.float64)

        self.observation_space = spaces.Dict(
            {
                "observation": box(*(one.name for one in self._fields)),
                "achieved_goal": box(spec.achieved),
                "desired_goal": box(spec.desired),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; a seed makes this and all later episodes repeatable.

        Raises:
            SamplingError: the tokens find no room to start.
        """
        super().reset(seed=seed, options=options)
        seen = self._env.reset([self.np_random])
        self._steps, self._ended = 0, False
        return self._observation(seen), {}

    def step(self, action: Singles) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Play one action of shape (A,).

        Raises:
            ValueError: the action has another shape or is not finite.
            RuntimeError: the episode is over, or none was begun.
        """
        spec, size = self.task.spec, self.task.spec.action_size
        if self._ended or self._steps >= spec.horizon:
            raise RuntimeError(
                f"the episode of {spec.horizon} steps is over or was not begun: call reset first"
            )
        given = np.asarray(action, np.float32)
        if given.shape != (size,) or not np.isfinite(given).all():
            raise ValueError(f"an action must be {size} finite numbers, got {action!r}")
        step = self._env.step(np.clip(given, -1.0, 1.0)[None])
        self._steps, self._ended = self._steps + 1, bool(step.terminated[0])
        cut = not self._ended and self._steps == spec.horizon
        info = {"is_success": self._ended, **self._env.told()}
        return self._observation(step.seen), float(step.rewards[0]), self._ended, cut, info

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:  # noqa: ARG002 - goal environments have it
        """Compute the reward of one pair of goals as a float, or of n pairs as (n,).

        With pictures, a step's own reward is measured on the pictures. This one is measured on the
        observed corners, so both differ a little.
        """
        rewards: Floats = self.task.rewards(*self._goals(achieved_goal, desired_goal))
        return float(rewards[0]) if np.ndim(achieved_goal) == 1 else rewards

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:  # noqa: ARG002
        """Whether a step with these goals terminates: a bool, or (n,) for n pairs of goals."""
        achieved, desired = self._goals(achieved_goal, desired_goal)
        recorded = np.full(len(achieved), self._ended)
        ended: Bools = self.task.ended(achieved, desired, recorded)
        return bool(ended[0]) if np.ndim(achieved_goal) == 1 else ended

    def compute_truncated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:
        """Whether the time limit is reached without termination: a bool, or (n,) for n pairs."""
        ended = self.compute_terminated(achieved_goal, desired_goal, info)
        return np.logical_not(ended) & (self._steps >= self.task.spec.horizon)

    def render(self) -> Pixels | None:
        """A picture (size, size, 3); None without a render mode, or if the task has no pictures."""
        return None if self.render_mode is None else self._env.picture(self._size)

    def close(self) -> None:
        """Free the engine."""
        self._env.close()

    def __getstate__(self) -> NoReturn:
        """Refuse copies: two environments would move the tokens of one engine."""
        raise TypeError("an environment holds an engine and cannot be copied: make another one")

    def _goals(self, achieved: Array, desired: Array) -> tuple[Floats, Floats]:
        """Reshape vectors, or n rows of vectors, to goals (n, *shape of the field).

        Raises:
            ValueError: a shape is wrong, or the numbers of rows differ.
        """
        spec, rows = self.task.spec, np.shape(achieved)[:-1]
        goals = [np.asarray(one, np.float64) for one in (achieved, desired)]
        shapes = [spec.field(name).shape for name in (spec.achieved, spec.desired)]
        for goal, shape in zip(goals, shapes, strict=True):
            wanted = (*rows, math.prod(shape))
            if goal.shape != wanted or len(rows) > 1:
                raise ValueError(f"a goal must have shape {wanted[-2:]}, got {goal.shape}")
        first, second = (g.reshape(-1, *s) for g, s in zip(goals, shapes, strict=True))
        return first, second

    def _observation(self, seen: Arrays) -> Observation:
        """Copies of the first row of each field, flat."""
        spec = self.task.spec
        flat = {name: np.array(rows[0], np.float64).ravel() for name, rows in seen.items()}
        return {
            "observation": np.concatenate([flat[one.name] for one in self._fields]),
            "achieved_goal": flat[spec.achieved],
            "desired_goal": flat[spec.desired],
        }


def place(
    shapes: Sequence[Any] = ("square",),
    scale: float = SQUARE_SCALE,
    reward: str = "overlap",
    render_mode: str | None = None,
    render_size: int = 240,
    **sim: Any,
) -> TaskEnv:
    """Make an environment of task=place: tokens are moved onto their target.

    Args:
        shapes: shapes of the tokens, see `TokensConfig`.
        scale: scale of the tokens; the default makes the square's side 0.4.
        reward: the name of a reward.
        render_mode: see `TaskEnv`.
        render_size: see `TaskEnv`.
        **sim: the fields of `SimConfig`, such as backend="kinematic".
    """
    world = from_mapping(SimConfig, sim, "sim")
    task = Place(_tokens(shapes, scale), world, RewardConfig(name=reward))
    return TaskEnv(task, render_mode, render_size)


def push(
    shapes: Sequence[Any] = ("square",),
    scale: float = SQUARE_SCALE,
    render_mode: str | None = None,
    render_size: int = 240,
    **task: Any,
) -> TaskEnv:
    """Make an environment of task=push; see `place`, but `task` has fields of `PushConfig`."""
    config = from_mapping(PushConfig, task, "task")
    return TaskEnv(Push(_tokens(shapes, scale), config), render_mode, render_size)


def _tokens(shapes: Sequence[Any], scale: float) -> TokensConfig:
    return from_mapping(TokensConfig, {"shapes": shapes, "scale": scale}, "tokens")
