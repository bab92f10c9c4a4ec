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
    """B environments, one after the other; one that terminates plays on."""

    def __init__(self, judge: Judge, config: GymConfig, count: int) -> None:
        self.count = count
        self._judge, self._config = judge, config
        self._envs: list[Environment] = [judge.make() for _ in range(count)]
        self._success = np.zeros(count, bool)
        self._desired: Array = np.zeros((count, 0))

    def reset(self, generators: Generators) -> Arrays:
        """Begin episodes whose seeds are the first number of their generators."""
        if self._config.fresh:
            self.close()
            self._envs = [self._judge.make() for _ in range(self.count)]
        seen = []
        for i, (env, generator) in enumerate(zip(self._envs, generators, strict=True)):
            own, info = env.reset(seed=int(generator.integers(2**31)))
            seen.append(own)
            self._success[i] = bool(succeeded(info))  # Fetch does not tell it yet: no
        together = _stacked(seen)
        self._desired = together[DESIRED]
        return _singles(together)

    def step(self, actions: Singles) -> Step:
        """What each environment gave; reward and end are those of goals in float32.

        Raises:
            ConfigError: it ends where its goals do not tell it.
            RunError: its goal moved.
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
                "hindsight cannot follow: play an environment whose goals stay"
            )
        self._check_ends(together, ended)
        singles = _singles(together)
        goals = singles[ACHIEVED], singles[DESIRED]
        return Step(singles, self._judge.rewards(*goals), self._judge.ended(*goals))

    def facts(self) -> Arrays:
        """Whether each is a success now, as the environment says."""
        return {SUCCESS: self._success.copy()}

    def told(self) -> Json:
        """Whether the first is a success, as it says: it may never terminate."""
        return {"is_success": bool(self._success[0])}

    def close(self) -> None:
        """Close all."""
        for env in self._envs:
            env.close()
        self._envs = []

    def _check_ends(self, seen: Seen, ended: Bools) -> None:
        """By goals in the environment's own precision."""
        if not self._config.ends:
            return
        wrong = ended != self._judge.ended(seen[ACHIEVED], seen[DESIRED])
        if wrong.any():
            what = "terminated" if ended[wrong][0] else "did not terminate"
            raise ConfigError(
                f"task.id={self._config.id} {what} where its goals say otherwise, so hindsight "
                "cannot tell what ends for another goal: set task.ends=false"
            )


def _stacked(seen: list[Seen]) -> Seen:
    """What B environments show, in one, in their own precision."""
    names = OBSERVATION, ACHIEVED, DESIRED
    return {name: np.stack([one[name] for one in seen]) for name in names}


def _singles(seen: Seen) -> Seen:
    return {name: array.astype(np.float32) for name, array in seen.items()}
