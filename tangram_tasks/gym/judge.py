"""Inspection of one environment: spec, rewards, terminations, and whether it can be learned.

Legend: n rows, G entries of a goal, A entries of an action.
"""

import importlib
import weakref
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces

from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.errors import ConfigError
from tangram_core.run.code import check_module
from tangram_core.run.process import quiet
from tangram_core.spec import MAX_REWARD, Array, EpisodeSpec, Field
from tangram_tasks.gym.task import SUCCESS, GymConfig

OBSERVATION, ACHIEVED, DESIRED = "observation", "achieved_goal", "desired_goal"
MOST = 1e6  # largest observed number; only errors lie beyond
FAR = 1e3  # entry of a goal that is tried where its space has no bounds
TRIED = 10  # random steps that are played for inspection
INSTALL = (  # apart: panda-gym needs PyBullet, which is not built for every Python
    "install its package; for Fetch: pip install gymnasium-robotics 'mujoco<3.12'; for Panda, with "
    "Python 3.11 on x86-64: pip install panda-gym"
)
Environment = gymnasium.Env[Any, Any]


class Judge:
    """Makes environments of one id; one of them computes rewards and terminations.

    Attributes:
        spec: names, shapes and bounds of the arrays in an episode.
        low, high: (A,) bounds of the environment's own actions.
    """

    def __init__(self, config: GymConfig) -> None:
        """Make one environment and inspect it.

        Raises:
            ConfigError: the environment cannot be made or learned; the text names a remedy.
        """
        self._config = config
        self._horizon = self._registered()
        self.env = self.make()
        weakref.finalize(self, self.env.close)  # engines complain at exit if left open
        sizes = {name: self._box(name).shape[0] for name in (OBSERVATION, ACHIEVED, DESIRED)}
        if sizes[ACHIEVED] != sizes[DESIRED]:
            self._refuse("its achieved and desired goals differ in size")
        self.low, self.high = self._action_bounds()
        self._compute: Callable[..., Any] = self._method("compute_reward")
        rewards = self._look()
        self.spec = EpisodeSpec(
            horizon=self._horizon,
            action_size=len(self.low),
            fields=tuple(
                Field(name, (size,), -MOST, MOST, "episode" if name == DESIRED else "moment")
                for name, size in sizes.items()
            ),
            achieved=ACHIEVED,
            desired=DESIRED,
            rewards=(-1.0, 0.0) if set(rewards) <= {-1.0, 0.0} else (-MAX_REWARD, MAX_REWARD),
        )

    def make(self) -> Environment:
        """Make a new environment without a time limit.

        Raises:
            ConfigError: the environment's own code fails, for example for lack of a package.
        """
        try:
            with quiet(1, 2):
                return gymnasium.make(
                    self._config.id, max_episode_steps=-1, disable_env_checker=True
                )
        except Exception as error:  # whatever the environment's own code raises
            why = f"{type(error).__name__}: {error}".strip().splitlines()[0]
            raise ConfigError(
                f"task.id={self._config.id} cannot be made ({why}): {INSTALL}"
            ) from error

    def scaled(self, actions: Singles) -> Singles:
        """Scale actions (B, A) from [-1, 1] to the action space; rounding stays within bounds."""
        scaled = self.low + (actions + 1.0) * 0.5 * (self.high - self.low)
        return np.clip(scaled, self.low, self.high)

    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """Rewards (n,) of achieved and desired goals (n, G)."""
        return np.asarray(self._compute(achieved, desired, {}), np.float64)

    def ended(self, achieved: Array, desired: Array) -> Bools:
        """(n,) whether steps with achieved goals (n, G) terminate for desired goals (n, G).

        Calls `compute_terminated`, as in gymnasium-robotics. Without that method, a step terminates
        where its reward is that of a reached goal, as in Panda; `GymEnv` checks this.
        """
        if not self._config.ends:
            return np.zeros(len(achieved), bool)
        return self._ended(achieved, desired)

    def _at_best(self, achieved: Array, desired: Array) -> Bools:
        reached: Bools = self.rewards(achieved, desired) == self._best
        return reached

    def _at_once(self, achieved: Array, desired: Array) -> Bools:
        found = np.asarray(self._terminated(achieved, desired, {}), bool)
        if found.shape == (len(achieved),):
            return found
        # One value for all rows: False is trusted, True is checked row by row.
        none = np.zeros(len(achieved), bool)
        return self._one_by_one(achieved, desired) if found.any() else none

    def _one_by_one(self, achieved: Array, desired: Array) -> Bools:
        rows = zip(achieved, desired, strict=True)
        return np.fromiter((self._terminated(*row, {}) for row in rows), bool, len(achieved))

    def repeats(self) -> bool:
        """Whether an episode repeats exactly after another episode was played."""
        first, _, again = (self._played(seed) for seed in (0, 1, 0))
        return np.array_equal(first, again)

    def _played(self, seed: int) -> Floats:
        """Observations in an episode of random actions."""
        rng = np.random.default_rng(seed)
        observed = [self.env.reset(seed=seed)[0][OBSERVATION]]
        for _ in range(self._horizon):
            action = self.scaled(rng.uniform(-1, 1, len(self.low)).astype(np.float32))
            observed.append(self.env.step(action)[0][OBSERVATION])
        return np.array(observed)

    def _registered(self) -> int:
        """Import the modules of task.imports; returns the registered steps of an episode."""
        config = self._config
        if not config.id:
            raise ConfigError("task.id must name an environment, got '': set task.id=FetchReach-v4")
        for module in config.imports:
            check_module("task.imports", module)
            try:
                with quiet(1, 2):
                    importlib.import_module(module)
            except Exception as error:  # whatever its code raises
                raise ConfigError(
                    f"task.imports: cannot import {module} ({error}): {INSTALL}"
                ) from error
        try:
            horizon = gymnasium.spec(config.id).max_episode_steps
        except gymnasium.error.Error as error:
            raise ConfigError(
                f"task.id={config.id} is not registered: correct the id, or add to task.imports "
                "the module that registers it, such as panda_gym"
            ) from error
        if not horizon:
            self._refuse("it has no time limit: register it with max_episode_steps")
        return horizon

    def _box(self, name: str) -> spaces.Box:
        """The space of one entry of the observation."""
        space = self.env.observation_space
        part = space.get(name) if isinstance(space, spaces.Dict) else None
        if part is None:
            self._refuse(f"its observation is no dict with {name}: choose a goal environment")
        if not isinstance(part, spaces.Box) or len(part.shape) != 1 or part.dtype == np.uint8:
            self._refuse(f"its {name} is {part}, and must be a vector of numbers, no picture")
        return part

    def _action_bounds(self) -> tuple[Singles, Singles]:
        space = self.env.action_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1 or not space.is_bounded():
            self._refuse(f"its actions are {space}, and must be a bounded vector of numbers")
        return space.low.astype(np.float32), space.high.astype(np.float32)

    def _method(self, name: str) -> Any:
        """A method of the environment, or of a wrapper that it was registered with."""
        if not self.env.has_wrapper_attr(name):
            self._refuse(f"it has no {name}: choose a goal environment")
        return self.env.get_wrapper_attr(name)

    def _look(self) -> Floats:
        """Play a few random steps, and compare their rewards with those computed from the goals."""
        rng = np.random.default_rng(0)
        seen, _ = self.env.reset(seed=0)
        achieved, desired, paid = [seen[ACHIEVED]], seen[DESIRED], []
        for _ in range(TRIED):
            action = self.scaled(rng.uniform(-1, 1, len(self.low)).astype(np.float32))
            seen, reward, _, _, info = self.env.step(action)
            if succeeded(info) is None:
                self._refuse(f"its info lacks {SUCCESS}, which the scores need: add it in step")
            achieved.append(seen[ACHIEVED])
            paid.append(float(reward))
        # The last rows are goals that a few random steps do not reach.
        space, far = self._box(ACHIEVED), rng.choice([-FAR, FAR], (TRIED, len(desired)))
        A = np.concatenate([[desired], achieved, achieved, far.clip(space.low, space.high)])
        D = np.concatenate([[desired] * (1 + len(achieved)), achieved[::-1], [desired] * TRIED])
        found = self._whole(A, D)
        if not np.allclose(found[2 : 1 + len(achieved)], paid, rtol=1e-4, atol=1e-6):
            self._refuse("its step rewards differ from compute_reward of the goals alone")
        self._best = float(found[0])
        self._ended: Callable[[Array, Array], Bools] = self._at_best
        if self.env.has_wrapper_attr("compute_terminated"):
            self._terminated: Callable[..., Any] = self.env.get_wrapper_attr("compute_terminated")
            self._ended = self._at_once if self._takes_arrays(A, D) else self._one_by_one
        return found

    def _takes_arrays(self, achieved: Array, desired: Array) -> bool:
        """Whether `compute_terminated` gives the same for arrays as for each row.

        If not, each row takes a call, and a thousand calls take longer than an update.
        """
        try:
            found = self._at_once(achieved, desired)
        except Exception:  # noqa: BLE001  # whatever the environment's own code raises
            return False
        return bool((found == self._one_by_one(achieved, desired)).all())

    def _whole(self, achieved: Array, desired: Array) -> Floats:
        """Rewards (n,) of arrays of goals; refused if single rows give others."""
        rows, why = zip(achieved, desired, strict=True), ""
        try:
            found = self.rewards(achieved, desired)
            single = np.array([float(self._compute(*row, {})) for row in rows])
            agree = found.shape == single.shape and np.allclose(found, single)
        except Exception as error:  # noqa: BLE001  # whatever the environment's own code raises
            agree, why = False, f" ({type(error).__name__}: {error})".splitlines()[0]
        if not agree:
            self._refuse(
                f"its compute_reward does not take arrays of goals (n, {achieved.shape[1]}) and "
                f"info={{}}{why}: let it compute along the last axis"
            )
        return found

    def _refuse(self, why: str) -> NoReturn:
        raise ConfigError(f"task.id={self._config.id} cannot be learned: {why}")


def succeeded(info: Mapping[str, Any]) -> bool | None:
    """Whether `info` reports success, by `is_success` or `success`; None if it has neither."""
    found = info.get(SUCCESS, info.get("success"))
    return None if found is None else bool(found)
