"""TangramVectorEnv: several tangram worlds in step, as gymnasium's vector environment."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tangram_core.arrays import Bools, Floats, Pixels
from tangram_core.errors import ConfigError
from tangram_core.settings import check_range
from tangram_sim.env import TangramEnv, check_render_mode
from tangram_sim.table import Observation, Table

MAX_ENVS = 4096
Stepped = tuple[Observation, Floats, Bools, Bools, dict[str, Any]]


class TangramVectorEnv(VectorEnv[Observation, npt.NDArray[np.float32], Any]):
    """`num_envs` environments in one process, over one `BatchedEnv`: what make_vec makes.

    Each plays the episodes that `TangramEnv` plays with the same seed, and is told of them in the
    same words. All episodes have the same length, so that all are reset at once.
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        """Make the worlds.

        Args:
            num_envs: how many.
            max_episode_steps: steps after which an episode is truncated, as gymnasium's TimeLimit
                does around a single environment; None: where it ends by itself.
            autoreset_mode: NextStep: the step after the last of an episode resets, and its action
                is not played. SameStep: the last step itself resets, `final_obs` and `final_info`
                in its info have what it came to.
            render_mode: None or rgb_array.
            **settings: those of `TangramEnv`.

        Raises:
            ConfigError: a setting that cannot work.
        """
        self.closed = True  # older gymnasium closes even what was refused
        check_render_mode(render_mode)
        modes = {AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP}
        if autoreset_mode not in modes | {mode.value for mode in modes}:
            raise ConfigError(f"autoreset_mode must be NextStep or SameStep, got {autoreset_mode}")
        check_range("num_envs", num_envs, 1, MAX_ENVS)
        if max_episode_steps is not None:
            check_range("max_episode_steps", max_episode_steps, 1)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = TangramEnv.metadata | {"autoreset_mode": self._mode}
        self._table = Table(num_envs, **settings)
        self._limit = max_episode_steps
        self.batch = self._table.batch
        self.single_action_space = self._table.action_space
        self.single_observation_space = self._table.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._over = False  # the next step resets
        self.closed = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: of the first one, the others count on from it; or one for each. Without, the
                streams of randomness go on.
            options: not used.

        Raises:
            ConfigError: not as many seeds as environments, or a reset of some of them only.
            SamplingError: no layout without overlap was found.
        """
        if not np.all((options or {}).get("reset_mask", True)):
            raise ConfigError(
                "reset_mask leaves environments out, and these are reset together: leave it out, "
                "or make them with vectorization_mode='sync'"
            )
        seeds: Any = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        if seeds is not None and (not isinstance(seeds, Sequence) or len(seeds) != self.num_envs):
            got = len(seeds) if isinstance(seeds, Sequence) else f"a {type(seeds).__name__}"
            raise ConfigError(f"seed must be an int or list {self.num_envs} seeds, got {got}")
        for i, own in enumerate(seeds or ()):
            if own is not None:
                self._generators[i] = gymnasium.utils.seeding.np_random(own)[0]
        self._begin()
        return self._table.observations(), {}

    def step(self, actions: npt.NDArray[np.float32]) -> Stepped:
        """Play one action each, (B, A), or reset where all episodes are over; see the class."""
        if self._over:
            self._begin()
            none = np.zeros(self.num_envs, dtype=np.bool_)
            return self._table.observations(), np.zeros(self.num_envs), none, none.copy(), {}
        result = self._table.step(np.asarray(actions, dtype=np.float64))
        terminated, truncated = self._table.ends(result)
        if self.batch.steps_done == self._limit:
            truncated = np.ones(self.num_envs, dtype=np.bool_)
        over = bool((terminated | truncated).any())
        infos: dict[str, Any] = {}
        seen = self._table.observations()
        same_step = over and self._mode is AutoresetMode.SAME_STEP
        for i in range(self.num_envs):
            info = self._table.info(result, i)
            if same_step:
                final = {name: entry[i] for name, entry in seen.items()}
                info = {"final_obs": final, "final_info": info}
            infos = self._add_info(infos, info, i)
        self._over = over
        if same_step:
            self._begin()
            seen = self._table.observations()
        return seen, result.rewards, terminated, truncated, infos

    def render(self) -> tuple[Pixels, ...] | None:
        """The scenes, each (size, size, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self._table.picture(i) for i in range(self.num_envs))

    def close_extras(self) -> None:
        """Free the engine."""
        self.batch.close()

    def _begin(self) -> None:
        self._table.reset(self._generators)
        self._over = False
