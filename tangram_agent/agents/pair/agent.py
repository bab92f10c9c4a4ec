"""The agent of pairs: a velocity and a value for each pair of a token and a piece of the target."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar, cast

from tangram_agent.agents.pair.config import PairConfig
from tangram_agent.base.checks import check_capacity, seen_tokens
from tangram_agent.base.config import NetConfig
from tangram_core.agent import Agent, Pace
from tangram_core.settings import refuse_ignored, told
from tangram_core.task import Json, Task
from tangram_sim.config import RewardConfig
from tangram_tasks.place import Place

if TYPE_CHECKING:  # need torch
    from tangram_agent.agents.pair.actor import PairActor
    from tangram_agent.agents.pair.learner import PairLearner


@dataclass(frozen=True)
class Pair(Agent):
    """Learns the angle, too, and any number of tokens with one network."""

    sections: ClassVar = {"agent": PairConfig, "net": NetConfig}

    config: PairConfig
    net: NetConfig

    @property
    def pace(self) -> Pace:
        """As its settings say."""
        return self.config.pace

    def check(self, task: Task) -> None:
        """It plays tokens whose target is seen; what several of them cannot use is refused."""
        place = seen_tokens(task, "pair")
        check_capacity(place, self.config.replay_capacity)
        if place.layout.tokens > 1:
            self._check_credit(place, f"{place.layout.tokens} tokens on pairs")

    def _check_credit(self, task: Place, several: str) -> None:
        """Refuse what several tokens on pairs cannot use, or cannot learn."""
        whole = "set agent=paper, which values the whole scene"
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

    def learner(
        self, task: Task, seed: int, device: str = "cpu", *, compiled: bool = False
    ) -> "PairLearner":
        """See `Agent.learner`."""
        from tangram_agent.agents.pair.learner import PairLearner  # noqa: PLC0415

        return PairLearner(cast("Place", task), self.config, self.net, seed, device, compiled)

    def facts(self) -> Json:
        """Its preset and its network."""
        return {"agent": self.config.name, "net": self.net.kind}
