"""The paper's agent: it sees the whole scene and moves the set's next token (Sec. IV-A)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

from tangram_agent.base.agent import TokenAgent, seen_tokens
from tangram_agent.base.config import ActorCriticConfig, NetConfig
from tangram_core.errors import ConfigError
from tangram_core.settings import LEARNING, NETWORK, setting
from tangram_core.task import Task
from tangram_tasks.place import Place

if TYPE_CHECKING:  # need torch
    from tangram_agent.agents.scene.actor import SceneActor
    from tangram_agent.agents.scene.learner import SceneLearner
    from tangram_agent.agents.scene.networks import ActorNet, CriticNet
    from tangram_sim.geometry.layout import Layout


@dataclass(frozen=True)
class SceneConfig(ActorCriticConfig, section="agent"):
    """Settings of DDPG with hindsight on whole scenes, and of what the paper leaves open."""

    flags: bool = setting(
        True,
        "whether networks see which tokens are placed; false: attention sees all as placed, a "
        "perceptron sees only coordinates",
        part=NETWORK,
    )
    actor_tanh: int = setting(
        1, "times that tanh is applied to the actor's output", low=1, high=2, part=NETWORK
    )
    critic_tanh: bool = setting(
        False, "whether tanh is applied to the critic's output", part=NETWORK
    )
    noise_inside: bool = setting(
        False, "whether exploration noise is added before the last tanh, not after", part=LEARNING
    )
    actor_delay: int = setting(
        1, "updates of the critic for each update of the actor", low=1, part=LEARNING
    )


@dataclass(frozen=True)
class Scene(TokenAgent):
    """The paper's agent: a velocity for the next token, and a value of the whole scene."""

    sections: ClassVar = {"agent": SceneConfig, "net": NetConfig}

    config: SceneConfig

    def check(self, task: Task) -> None:
        """Refuse tasks that hide the pieces, and several tokens without `flags`."""
        place = seen_tokens(task, "scene")
        super().check(task)
        if place.layout.tokens > 1 and not self.config.flags:
            raise ConfigError(
                f"agent.flags=false with {place.layout.tokens} tokens hides from networks which "
                "one is to move: set agent.flags=true"
            )

    def actor(self, task: Task) -> "SceneActor":
        """See `Agent.actor`."""
        from tangram_agent.agents.scene.actor import SceneActor  # noqa: PLC0415

        place = cast("Place", task)
        return SceneActor(place, self.config, self.networks(place.layout)[0])

    def networks(self, layout: "Layout") -> "tuple[ActorNet, CriticNet]":
        """Actor and critic before their weights are set; subclasses may return other ones."""
        from tangram_agent.agents.scene.networks import ActorNet, CriticNet  # noqa: PLC0415
        from tangram_agent.agents.scene.scenes import SceneGraph  # noqa: PLC0415

        graph = SceneGraph(layout, self.config.flags)
        actor = ActorNet(graph, self.net, tanh=self.config.actor_tanh)
        return actor, CriticNet(graph, self.net, tanh=self.config.critic_tanh)

    def learns(self) -> "type[SceneLearner]":
        """The learner's class."""
        from tangram_agent.agents.scene.learner import SceneLearner  # noqa: PLC0415

        return SceneLearner
