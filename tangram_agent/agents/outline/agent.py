"""The agent for outlines: its actions are exact, and it learns a value of the resulting states."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

from tangram_agent.base.agent import TokenAgent
from tangram_agent.base.config import LearningConfig, NetConfig
from tangram_core.errors import ConfigError
from tangram_core.settings import LEARNING, refuse_ignored, setting
from tangram_core.task import Task
from tangram_tasks.fill import Fill

if TYPE_CHECKING:  # need torch
    from tangram_agent.agents.outline.actor import OutlineActor
    from tangram_agent.agents.outline.learner import FillLearner


@dataclass(frozen=True)
class OutlineConfig(LearningConfig, section="agent"):
    """Settings of Q-learning over afterstates with hindsight."""

    polyak: float = setting(0.99, "rho of the target network, Eq. 4", low=0, high=1, part=LEARNING)
    copies: int = setting(6, "hindsight states for each episode", low=1, high=64, part=LEARNING)


@dataclass(frozen=True)
class Outline(TokenAgent):
    """An agent that sees the outline of the target, but not its pieces."""

    sections: ClassVar = {"agent": OutlineConfig, "net": NetConfig}

    config: OutlineConfig

    def check(self, task: Task) -> None:
        """Refuse tasks without outlines, and networks without attention."""
        if not isinstance(task, Fill):
            raise ConfigError("agent.kind=outline fills outlines: set task=fill, or another agent")
        if self.net.kind == "mlp":
            refuse_ignored("net.kind=mlp", "outlines", "set net.kind=mha")
        super().check(task)

    def check_training(self, *, compiled: bool = False) -> None:
        """Refuse compiled updates."""
        if compiled:
            refuse_ignored("service.compile=true", "agent.kind=outline", "leave it out", False)

    def actor(self, task: Task) -> "OutlineActor":
        """See `Agent.actor`."""
        from tangram_agent.agents.outline.actor import OutlineActor  # noqa: PLC0415

        return OutlineActor(cast("Fill", task), self.config, self.net)

    def learns(self) -> "type[FillLearner]":
        """The learner's class."""
        from tangram_agent.agents.outline.learner import FillLearner  # noqa: PLC0415

        return FillLearner
