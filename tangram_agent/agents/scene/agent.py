"""The paper's agent: it sees the whole scene and moves the set's next token (Sec. IV-A)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

from tangram_agent.base.checks import check_capacity, seen_tokens
from tangram_agent.base.config import ActorCriticConfig, NetConfig
from tangram_core.agent import Agent, Pace
from tangram_core.task import Json, Task
from tangram_tasks.place import Place

if TYPE_CHECKING:  # need torch
    from tangram_agent.agents.scene.actor import SceneActor
    from tangram_agent.agents.scene.learner import SceneLearner


@dataclass(frozen=True)
class SceneConfig(ActorCriticConfig, section="agent"):
    """DDPG on whole scenes."""


@dataclass(frozen=True)
class Scene(Agent):
    """One velocity for the next token, one value of the whole scene."""

    sections: ClassVar = {"agent": SceneConfig, "net": NetConfig}

    config: SceneConfig
    net: NetConfig

    @property
    def pace(self) -> Pace:
        """As its settings say."""
        return self.config.pace

    def check(self, task: Task) -> None:
        """It plays tokens whose target is seen."""
        check_capacity(seen_tokens(task, "scene"), self.config.replay_capacity)

    def actor(self, task: Task) -> "SceneActor":
        """See `Agent.actor`."""
        from tangram_agent.agents.scene.actor import SceneActor  # noqa: PLC0415

        return SceneActor(cast("Place", task), self.config, self.net)

    def learner(
        self, task: Task, seed: int, device: str = "cpu", *, compiled: bool = False
    ) -> "SceneLearner":
        """See `Agent.learner`."""
        from tangram_agent.agents.scene.learner import SceneLearner  # noqa: PLC0415

        return SceneLearner(cast("Place", task), self.config, self.net, seed, device, compiled)

    def facts(self) -> Json:
        """Its preset and its network."""
        return {"agent": self.config.name, "net": self.net.kind}
