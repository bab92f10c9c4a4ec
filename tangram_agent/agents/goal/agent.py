"""The agent of DDPG, TD3 and SAC, and its settings; does not import torch."""

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
    """The algorithm and its own settings."""

    algorithm: str = setting(
        "td3",
        "ddpg: one critic; td3: the lower value of two critics and a delayed actor; sac: the lower "
        "value of two critics and a stochastic actor",
        choices=("ddpg", "td3", "sac"),
        part=NETWORK,
    )
    action_penalty: float = setting(
        0.1, "weight of squared actions in the actor's loss", low=0, part=LEARNING
    )
    actor_delay: int = setting(
        2,
        "updates of the critics for each update of the actor",
        low=1,
        only={"algorithm": "td3"},
        part=LEARNING,
    )


@dataclass(frozen=True)
class Goal(ActorCriticAgent):
    """DDPG, TD3 or SAC with hindsight, for any task whose fields are numbers."""

    sections: ClassVar = {"agent": GoalConfig}
    config: GoalConfig = GoalConfig()

    def learns(self) -> "type[GoalLearner]":
        """The learner's class, one for all three algorithms."""
        from tangram_agent.agents.goal.learner import GoalLearner  # noqa: PLC0415

        return GoalLearner

    def policy(self, inputs: int, actions: int) -> "Policy":
        """A deterministic policy, or a Gaussian one for SAC."""
        if self.config.algorithm != "sac":
            return super().policy(inputs, actions)
        from tangram_agent.agents.goal.gaussian import GaussianPolicy  # noqa: PLC0415

        return GaussianPolicy(inputs, actions, self.config)
