"""Base class of actor-critic agents; does not import torch."""

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from tangram_agent.flat.config import BaseConfig
from tangram_agent.flat.inputs import Inputs
from tangram_core.agent import Actor, Agent, Learner, Pace
from tangram_core.task import Json, Task

if TYPE_CHECKING:  # these load torch
    from tangram_agent.flat.actor_critic import ActorCritic
    from tangram_agent.flat.networks import Policy


@dataclass(frozen=True)
class ActorCriticAgent(Agent):
    """An actor-critic agent; a subclass adds its own settings and `learns`.

    @dataclass(frozen=True)
    class Mine(ActorCriticAgent):
        sections: ClassVar = {"agent": MyConfig}
        config: MyConfig = MyConfig()

        def learns(self) -> type[MyLearner]:
            return MyLearner
    """

    sections: ClassVar = {"agent": BaseConfig}
    config: BaseConfig = field(default_factory=BaseConfig)

    @abstractmethod
    def learns(self) -> "type[ActorCritic[Any]]":
        """The learner's class."""

    def policy(self, inputs: int, actions: int) -> "Policy":
        """A policy from rows of `inputs` entries to `actions`, the same for actor and learner."""
        from tangram_agent.flat.networks import Policy  # noqa: PLC0415

        return Policy(inputs, actions, self.config)

    @property
    def pace(self) -> Pace:
        """The pace in the settings."""
        return Pace(self.config.updates_per_transition, self.config.learning_starts)

    def facts(self) -> Json:
        """The agent's name, for reports."""
        return {"agent": type(self).__name__.lower()}

    def check(self, task: Task) -> None:
        """Refuse a task with fields that are not float numbers."""
        Inputs.check(task.spec)

    def actor(self, task: Task) -> Actor:
        """An actor whose weights are to be loaded."""
        from tangram_agent.flat.playing import PolicyActor  # noqa: PLC0415

        inputs = Inputs(task.spec)
        policy = self.policy(inputs.size, task.spec.action_size)
        return PolicyActor(policy, inputs, self.config.uniform_share)

    def learner(self, task: Task, seed: int, device: str, *, compiled: bool = False) -> Learner:
        """A learner with the weights of a seed."""
        return self.learns()(self, task, seed, device, compiled)
