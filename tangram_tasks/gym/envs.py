"""Several environments of gymnasium, played in step in one process.

Legend: B environments, A entries of an action.
"""

import numpy as np

from tangram_core.arrays import Bools, Singles
from tangram_core.errors import ConfigError, RunError
from tangram_core.spec import Array, Arrays
from tangram_core.task import Env, Generators, Json, Step
from tangram_tasks.gym.judge import (
    ACHIEVED,
    DESIRED,
    OBSERVATION,
    Environment,
    Judge,
    succeeded,
)
from tangram_tasks.gym.task import SUCCESS, GymConfig

Seen = dict[str, Array]


class GymEnv(Env):
    """B environments, stepped one after the other; a terminated one plays on."""

    def __init__(self, judge: Judge, config: GymConfig, count: int) -> None:
        self.count = count
        self._judge, self._config = judge, config
        self._envs: list[Environment] = [judge.make() for _ in range(count)]
        self._success = np.zeros(count, bool)
        self._desired: Array = np.zeros((count, 0))

    def reset(self, generators: Generators) -> Arrays:
        """Begin an episode in each environment, seeded by a number from its generator."""
        if self._config.fresh:
            self.close()
            self._envs = [self._judge.make() for _ in range(self.count)]
        seen = []
        for i, (env, generator) in enumerate(zip(self._envs, generators, strict=True)):
            own, info = env.reset(seed=int(generator.integers(2**31)))
            seen.append(own)
            self._success[i] = bool(succeeded(info))  # Fetch reports no success at reset: False
        together = _stacked(seen)
        self._desired = together[DESIRED]
        return _singles(together)

    def step(self, actions: Singles) -> Step:
        """Play actions (B, A); rewards and terminations are computed from float32 goals.

        Raises:
            ConfigError: an environment terminates where its goals say otherwise.
            RunError: a desired goal moved within an episode.
        """
        seen, ended = [], np.zeros(self.count, bool)
        for i, (env, action) in enumerate(
            zip(self._envs, self._judge.scaled(actions), strict=True)
        ):
            own, _, ended[i], _, info = env.step(action)
            seen.append(own)
            self._success[i] = bool(succeeded(info))
        together = _stacked(seen)
        if not np.array_equal(together[DESIRED], self._desired):
            raise RunError(
                f"task.id={self._config.id}: its desired goal moved within an episode, which "
                "hindsight cannot follow: choose an environment whose goals stay fixed"
            )
        self._check_ends(together, ended)
        singles = _singles(together)
        goals = singles[ACHIEVED], singles[DESIRED]
        return Step(singles, self._judge.rewards(*goals), self._judge.ended(*goals))

    def facts(self) -> Arrays:
        """(B,) whether each environment reports success now."""
        return {SUCCESS: self._success.copy()}

    def told(self) -> Json:
        """Whether the first environment reports success; it may do so without termination."""
        return {"is_success": bool(self._success[0])}

    def close(self) -> None:
        """Close all environments."""
        for env in self._envs:
            env.close()
        self._envs = []

    def _check_ends(self, seen: Seen, ended: Bools) -> None:
        """Raise ConfigError if an end differs from that by goals in their own precision."""
        if not self._config.ends:
            return
        wrong = ended != self._judge.ended(seen[ACHIEVED], seen[DESIRED])
        if wrong.any():
            what = "terminated" if ended[wrong][0] else "did not terminate"
            raise ConfigError(
                f"task.id={self._config.id} {what} where its goals say otherwise, so hindsight "
                "cannot tell where an episode ends for another goal: set task.ends=false"
            )


def _stacked(seen: list[Seen]) -> Seen:
    """Observations of B environments stacked by name, in their own precision."""
    names = OBSERVATION, ACHIEVED, DESIRED
    return {name: np.stack([one[name] for one in seen]) for name in names}


def _singles(seen: Seen) -> Seen:
    return {name: array.astype(np.float32) for name, array in seen.items()}
