"""The agent of pairs: a velocity and a value for each pair of a token and a piece of the target."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar, cast

from tangram_agent.base.agent import TokenAgent, seen_tokens
from tangram_agent.base.config import ActorCriticConfig, NetConfig
from tangram_core.settings import refuse_ignored, setting, told
from tangram_core.task import Task
from tangram_sim.config import RewardConfig
from tangram_tasks.place import Place

if TYPE_CHECKING:  # need torch
    from tangram_agent.agents.pair.actor import PairActor
    from tangram_agent.agents.pair.learner import PairLearner


@dataclass(frozen=True)
class PairConfig(ActorCriticConfig, section="agent"):
    """Settings of DDPG on pairs of a token and a piece of the target."""

    reapply: int = setting(
        2, "times that the actor is applied again to its own proposal", low=0, high=100
    )


@dataclass(frozen=True)
class Pair(TokenAgent):
    """The agent of pairs: one network for any number of tokens, which learns angles, too."""

    sections: ClassVar = {"agent": PairConfig, "net": NetConfig}

    config: PairConfig

    def check(self, task: Task) -> None:
        """Refuse tasks that hide the pieces, and settings that several tokens cannot use."""
        place = seen_tokens(task, "pair")
        super().check(task)
        if place.layout.tokens > 1:
            self._check_credit(place, f"{place.layout.tokens} tokens on pairs")

    def _check_credit(self, task: Place, several: str) -> None:
        """Refuse what several tokens on pairs cannot use, or cannot learn."""
        whole = "set agent=paper agent.flags=true, which values the whole scene"
        if self.config.gamma > 0.0:
            refuse_ignored(f"agent.gamma={told(self.config.gamma)}", several, whole)
        for own in fields(RewardConfig):
            value = getattr(task.reward, own.name)
            if value != own.default:
                refuse_ignored(f"reward.{own.name}={told(value)}", several, whole)
        if any(relabel.strategy == "future" for relabel in self.config.hindsight):
            refuse_ignored("agent.hindsight.strategy=future", several, "use final")

    def actor(self, task: Task) -> "PairActor":
        """See `Agent.actor`."""
        from tangram_agent.agents.pair.actor import PairActor  # noqa: PLC0415

        return PairActor(cast("Place", task), self.config, self.net)

    def learns(self) -> "type[PairLearner]":
        """The learner's class."""
        from tangram_agent.agents.pair.learner import PairLearner  # noqa: PLC0415

        return PairLearner
