"""Environments with the goal interface of gymnasium, as a task.

Legend: E episodes, T steps of an episode, n rows, A entries of an action.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from tangram_core.arrays import Bools, Floats
from tangram_core.errors import ConfigError
from tangram_core.scores import Score
from tangram_core.settings import NETWORK, Settings, setting
from tangram_core.spec import Array, EpisodeSpec
from tangram_core.task import Env, Json, Played, Purpose, Task

if TYPE_CHECKING:  # the judge loads gymnasium
    from tangram_tasks.gym.judge import Judge

SUCCESS = "is_success"  # in gymnasium's info, and in the facts of a moment


@dataclass(frozen=True)
class GymConfig(Settings, section="task"):
    """Which environment of gymnasium is played."""

    id: str = setting("", "the environment's id at gymnasium, such as FetchReach-v4", part=NETWORK)
    imports: tuple[str, ...] = setting(
        (),
        "modules to import first, which register environments: gymnasium_robotics, panda_gym",
        part=NETWORK,
    )
    ends: bool = setting(
        True,
        "whether a step that terminates ends what counts; false: as if nothing ever terminated",
    )
    fresh: bool = setting(
        False,
        "make each environment anew for each episode: slow, and exact where an episode depends on "
        "the one before it, as PandaPush-v3 does",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if ":" in self.id:  # gymnasium would import what stands before it
            module, _, name = self.id.partition(":")
            raise ConfigError(
                f"task.id must not have a colon, got '{self.id}': "
                f"set task.imports=[{module}] task.id={name}"
            )


@dataclass(frozen=True)
class Gym(Task):
    """An environment whose observation is a dict of observation, achieved_goal and desired_goal.

    Every field is float32 within +-1e6, whatever its space says: PandaPush-v3 says 10 and reaches
    50. What an action of [-1, 1] does is scaled to the action space. Its `compute_reward` is what a
    step pays, of goals rounded to float32, so that the master comes to the same reward. The master
    makes one environment for it, the first time that the spec or a reward is asked for.
    """

    sections: ClassVar = {"task": GymConfig}
    scores: ClassVar = (
        Score("success", "success at the end, share"),
        Score("success_any", "success at any time, share"),
        Score("mean_return", "return", digits=1),
        Score("steps", "steps to the first success", digits=1),
    )
    config: GymConfig = GymConfig()

    @cached_property
    def judge(self) -> "Judge":
        """One environment, of which spec and rewards come; made when it is asked for first.

        Raises:
            ConfigError: it cannot be made, or cannot be learned.
        """
        from tangram_tasks.gym.judge import Judge  # noqa: PLC0415

        return Judge(self.config)

    @property
    def spec(self) -> EpisodeSpec:
        """What the environment's spaces and its registered time limit say."""
        return self.judge.spec

    def check(self, *, plays: bool) -> None:  # noqa: ARG002
        """Refuse what is no environment with goals, or is not installed: the master needs it too.

        Raises:
            ConfigError: names the setting and the remedy.
        """
        self.judge  # noqa: B018

    def check_exact(self) -> None:
        """Refuse an environment that plays otherwise after another episode, unless made anew."""
        if not (self.config.fresh or self.judge.repeats()):
            raise ConfigError(
                f"service.mode=lockstep, and task.id={self.config.id} plays an episode otherwise "
                "after another one: set task.fresh=true"
            )

    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """(n,) what the environment's own `compute_reward` says."""
        return self.judge.rewards(achieved, desired)

    def ended(self, achieved: Array, desired: Array, recorded: Bools) -> Bools:  # noqa: ARG002
        """(n,) whether it would terminate, by these goals alone."""
        return self.judge.ended(achieved, desired)

    def make(self, count: int, purpose: Purpose = "play") -> Env:  # noqa: ARG002
        """So many environments in this process.

        Raises:
            ConfigError: they cannot be made.
        """
        from tangram_tasks.gym.envs import GymEnv  # noqa: PLC0415

        return GymEnv(self.judge, self.config, count)

    def score(self, played: Played) -> dict[str, float]:
        """Success where an episode ends: where it terminates first, else at its last step."""
        terminated = played.episodes.terminated.astype(bool)
        horizon = terminated.shape[1]
        success = played.facts[SUCCESS][:, 1:].astype(bool)  # (E, T) after each step
        last = np.where(terminated.any(1), terminated.argmax(1), horizon - 1)
        first = np.where(success.any(1), success.argmax(1) + 1, horizon)
        counts = np.arange(horizon) <= last[:, None]
        return {
            "success": float(success[np.arange(len(last)), last].mean()),
            "success_any": float((success & counts).any(1).mean()),
            "mean_return": float((played.episodes.rewards * counts).sum(1).mean()),
            "steps": float(first.mean()),
        }

    def facts(self) -> Json:
        """Its id."""
        return {"task": self.config.id}
