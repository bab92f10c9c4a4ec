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
    from tangram_agent.agents.scene.networks import ActorNet, CriticNet
    from tangram_sim.geometry.layout import Layout


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

        place = cast("Place", task)
        return SceneActor(place, self.config, self.networks(place.layout)[0])

    def learner(
        self, task: Task, seed: int, device: str = "cpu", *, compiled: bool = False
    ) -> "SceneLearner":
        """See `Agent.learner`."""
        from tangram_agent.agents.scene.learner import SceneLearner  # noqa: PLC0415

        place = cast("Place", task)
        networks = self.networks(place.layout)
        return SceneLearner(place, self.config, networks, seed, device, compiled)

    def networks(self, layout: "Layout") -> "tuple[ActorNet, CriticNet]":
        """Actor and critic, with whatever weights; another kind of them overrides this."""
        from tangram_agent.agents.scene.networks import ActorNet, CriticNet  # noqa: PLC0415

        return ActorNet(layout, self.net), CriticNet(layout, self.net)

    def facts(self) -> Json:
        """Its preset and its network."""
        return {"agent": self.config.name, "net": self.net.kind}
