"""DDPG, TD3 and SAC for goals: settings, without tensors."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from tangram_agent.flat.agent import ActorCriticAgent
from tangram_agent.flat.config import BaseConfig
from tangram_core.settings import LEARNING, NETWORK, setting

if TYPE_CHECKING:  # these load torch
    from tangram_agent.agents.goal.learner import GoalLearner
    from tangram_agent.flat.networks import Policy


@dataclass(frozen=True)
class GoalConfig(BaseConfig, section="agent"):
    """Which algorithm, and what it has beside what all have."""

    algorithm: str = setting(
        "td3",
        "one critic (ddpg), the lesser of two and a delayed actor (td3), or also an actor that is "
        "random by itself (sac)",
        choices=("ddpg", "td3", "sac"),
        part=NETWORK,
    )
    action_penalty: float = setting(
        0.1, "weight in the actor's loss of squared actions", low=0, part=LEARNING
    )
    actor_delay: int = setting(
        2, "updates for each one of the actor", low=1, only={"algorithm": "td3"}, part=LEARNING
    )


@dataclass(frozen=True)
class Goal(ActorCriticAgent):
    """Learns any task whose fields are numbers, from its own goals and by hindsight."""

    sections: ClassVar = {"agent": GoalConfig}
    config: GoalConfig = GoalConfig()

    def learns(self) -> "type[GoalLearner]":
        """One learner for the three: they differ in a few lines of their losses."""
        from tangram_agent.agents.goal.learner import GoalLearner  # noqa: PLC0415

        return GoalLearner

    def policy(self, inputs: int, actions: int) -> "Policy":
        """Random by itself where the algorithm is SAC."""
        if self.config.algorithm != "sac":
            return super().policy(inputs, actions)
        from tangram_agent.agents.goal.gaussian import GaussianPolicy  # noqa: PLC0415

        return GaussianPolicy(inputs, actions, self.config)
