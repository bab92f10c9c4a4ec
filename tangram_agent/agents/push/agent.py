"""The agent of pushes, and its settings; does not import torch."""

from dataclasses import dataclass
from typing import ClassVar, cast

from tangram_agent.flat.config import EpisodeConfig
from tangram_core.agent import Actor, Agent, Learner, Pace
from tangram_core.errors import ConfigError
from tangram_core.settings import NETWORK, setting
from tangram_core.task import Json, Task
from tangram_tasks.push.task import Push


@dataclass(frozen=True)
class PushingConfig(EpisodeConfig, section="agent"):
    """Settings of the critic, and the number of pushes that it values."""

    width: int = setting(128, "width of all layers", low=8, high=4096, part=NETWORK)
    looked_at: int = setting(
        96,
        "pushes of each token that the critic values for an action while exploring; else four "
        "times as many, up to 1,024",
        low=2,
        high=1024,
    )
    tried: int = setting(
        0,
        "number of the best of these pushes that are tried in a physics engine before each action, "
        "with friction at the middle of its ranges; 0: none; not used while it learns",
        low=0,
        high=1024,
    )


@dataclass(frozen=True)
class Pushing(Agent):
    """Values random pushes of each token, by Q-learning with hindsight."""

    sections: ClassVar = {"agent": PushingConfig}
    config: PushingConfig = PushingConfig()

    @property
    def pace(self) -> Pace:
        """The pace in the settings."""
        return Pace(self.config.updates_per_transition, self.config.learning_starts)

    def check(self, task: Task) -> None:
        """Refuse a task without pushes."""
        if not isinstance(task, Push):
            kind = type(task).__name__.lower()
            raise ConfigError(
                f"agent=push learns only task=push, got task={kind}: set agent={task.agent}"
            )

    def actor(self, task: Task) -> Actor:
        """An actor whose weights are to be loaded."""
        from tangram_agent.agents.push.actor import PushActor  # noqa: PLC0415

        return PushActor(cast("Push", task), self.config)

    def learner(self, task: Task, seed: int, device: str, *, compiled: bool = False) -> Learner:
        """A learner with the weights of a seed."""
        from tangram_agent.agents.push.learner import PushLearner  # noqa: PLC0415

        return PushLearner(cast("Push", task), self.config, seed, device, compiled=compiled)

    def facts(self) -> Json:
        """Names of the agent and of its network, for reports."""
        return {"agent": "push", "net": f"pairs, {self.config.width} wide"}
