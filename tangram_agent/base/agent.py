"""An agent of an actor and critics, without tensors: settings, and who is made of them."""

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from tangram_agent.base.config import BaseConfig
from tangram_agent.base.inputs import Inputs
from tangram_core.agent import Actor, Agent, Learner, Pace
from tangram_core.task import Task

if TYPE_CHECKING:  # these load torch
    from tangram_agent.base.actor_critic import ActorCritic
    from tangram_agent.base.networks import Policy


@dataclass(frozen=True)
class ActorCriticAgent(Agent):
    """Extend it with settings of your own, and with `learns`.

    @dataclass(frozen=True)
    class Mine(ActorCriticAgent):
        sections: ClassVar = {"agent": MyConfig}
        agent: MyConfig = MyConfig()

        def learns(self) -> type[MyLearner]:
            return MyLearner
    """

    sections: ClassVar = {"agent": BaseConfig}
    agent: BaseConfig = field(default_factory=BaseConfig)

    @abstractmethod
    def learns(self) -> "type[ActorCritic[Any]]":
        """The class of its learner."""

    def policy(self, inputs: int, actions: int) -> "Policy":
        """A policy of rows of so many entries, the same for actor and learner."""
        from tangram_agent.base.networks import Policy  # noqa: PLC0415

        return Policy(inputs, actions, self.agent)

    @property
    def pace(self) -> Pace:
        """As the settings say."""
        return Pace(self.agent.updates_per_transition, self.agent.learning_starts)

    def check(self, task: Task) -> None:
        """Refuse a task whose fields are no numbers."""
        Inputs.check(task.spec)

    def actor(self, task: Task) -> Actor:
        """The policy, to be loaded."""
        from tangram_agent.base.playing import PolicyActor  # noqa: PLC0415

        inputs = Inputs(task.spec)
        policy = self.policy(inputs.size, task.spec.action_size)
        return PolicyActor(policy, inputs, self.agent.uniform_share)

    def learner(self, task: Task, seed: int, device: str, *, compiled: bool = False) -> Learner:
        """With the weights of a seed."""
        return self.learns()(self, task, seed, device, compiled)
