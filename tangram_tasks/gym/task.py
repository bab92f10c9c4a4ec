"""Task `gym`: an environment with the goal interface of gymnasium.

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

SUCCESS = "is_success"  # key in gymnasium's info and in `Env.facts`


@dataclass(frozen=True)
class GymConfig(Settings, section="task"):
    """The environment of gymnasium that is played, and how its episodes end and begin."""

    id: str = setting("", "gymnasium's id of the environment, such as FetchReach-v4", part=NETWORK)
    imports: tuple[str, ...] = setting(
        (),
        "modules that register environments, imported first: gymnasium_robotics, panda_gym",
        part=NETWORK,
    )
    ends: bool = setting(
        True,
        "true: an episode counts up to the step that terminates; false: termination is ignored",
    )
    fresh: bool = setting(
        False,
        "make a new environment for each episode: slow, but exact where episodes depend on the one "
        "before, as in PandaPush-v3",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if ":" in self.id:  # gymnasium would import the module before the colon
            module, _, name = self.id.partition(":")
            raise ConfigError(
                f"task.id must not have a colon, got '{self.id}': "
                f"set task.imports=[{module}] task.id={name}"
            )


@dataclass(frozen=True)
class Gym(Task):
    """An environment that observes a dict of observation, achieved_goal and desired_goal.

    Every field is float32 within +-1e6. The bounds of the environment's own spaces are not used:
    PandaPush-v3 declares 10 and reaches 50. Actions in [-1, 1] are scaled to the action space. The
    reward of a step is `compute_reward` of goals rounded to float32, so that the master computes
    the same. The master makes one environment when spec or rewards are first needed.
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
        """The environment that gives spec and rewards, made at the first use.

        Raises:
            ConfigError: the environment cannot be made or cannot be learned.
        """
        from tangram_tasks.gym.judge import Judge  # noqa: PLC0415

        return Judge(self.config)

    @property
    def spec(self) -> EpisodeSpec:
        """Horizon and fields, from the environment's registered time limit and its spaces."""
        return self.judge.spec

    def check(self, *, plays: bool) -> None:  # noqa: ARG002
        """Refuse an environment without goals or not installed; the master needs it, too.

        Raises:
            ConfigError: names the setting and the remedy.
        """
        self.judge  # noqa: B018

    def check_exact(self) -> None:
        """Raise ConfigError if episodes depend on earlier ones, unless `fresh` is set."""
        if not (self.config.fresh or self.judge.repeats()):
            raise ConfigError(
                f"service.mode=lockstep needs repeatable episodes, and episodes of "
                f"task.id={self.config.id} depend on earlier ones: set task.fresh=true"
            )

    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """Rewards (n,) by the environment's own `compute_reward`."""
        return self.judge.rewards(achieved, desired)

    def ended(self, achieved: Array, desired: Array, recorded: Bools) -> Bools:  # noqa: ARG002
        """(n,) whether steps terminate, computed from the goals alone."""
        return self.judge.ended(achieved, desired)

    def make(self, count: int, purpose: Purpose = "play") -> Env:  # noqa: ARG002
        """Make `count` environments in this process.

        Raises:
            ConfigError: an environment cannot be made.
        """
        from tangram_tasks.gym.envs import GymEnv  # noqa: PLC0415

        return GymEnv(self.judge, self.config, count)

    def score(self, played: Played) -> dict[str, float]:
        """Compute the scores; an episode ends where it first terminates, else at its last step."""
        horizon, last = played.episodes.steps, played.episodes.lengths - 1
        success = played.facts[SUCCESS][:, 1:].astype(bool)  # (E, T) after each step
        first = np.where(success.any(1), success.argmax(1) + 1, horizon)
        counts = np.arange(horizon) <= last[:, None]
        return {
            "success": float(success[np.arange(len(last)), last].mean()),
            "success_any": float((success & counts).any(1).mean()),
            "mean_return": float((played.episodes.rewards * counts).sum(1).mean()),
            "steps": float(first.mean()),
        }

    def facts(self) -> Json:
        """The environment's id, for result.json."""
        return {"task": self.config.id}
