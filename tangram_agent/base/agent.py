"""What agents of tokens share, without tensors."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tangram_agent.base.config import LearningConfig, NetConfig
from tangram_core.agent import Agent, Pace
from tangram_core.errors import ConfigError
from tangram_core.task import Json, Task
from tangram_tasks.place import Place

if TYPE_CHECKING:  # needs torch
    from tangram_agent.base.learning import TokenLearner


@dataclass(frozen=True)
class TokenAgent(Agent):
    """Its networks learn from a replay; extend it with `sections`, `actor` and `learns`."""

    config: LearningConfig
    net: NetConfig

    @property
    def pace(self) -> Pace:
        """As its settings say."""
        return Pace(self.config.updates_per_transition, self.config.learning_starts)

    def check(self, task: Task) -> None:
        """Refuse a replay that holds no episode."""
        capacity, horizon = self.config.replay_capacity, task.spec.horizon
        if capacity < horizon:
            raise ConfigError(
                f"agent.replay_capacity must hold an episode, {horizon} actions, got {capacity}"
            )

    @abstractmethod
    def learns(self) -> "Callable[[Any, Any, int, str, bool], TokenLearner]":
        """The class of its learner: of the agent, a task, a seed, a device, and `compiled`."""

    def learner(
        self, task: Task, seed: int, device: str = "cpu", *, compiled: bool = False
    ) -> "TokenLearner":
        """See `Agent.learner`."""
        return self.learns()(self, task, seed, device, compiled)

    def facts(self) -> Json:
        """Its preset and its network."""
        return {"agent": self.config.name, "net": self.net.kind}


def seen_tokens(task: Task, kind: str) -> Place:
    """The task, if it is one of tokens whose target is seen piece by piece.

    Raises:
        ConfigError: names the agent and what to set.
    """
    if not isinstance(task, Place) or task.outlines:
        raise ConfigError(
            f"agent.kind={kind} plays tokens whose target it sees: set task=place, or another "
            "agent, as agent=goal for fields that are numbers"
        )
    return task
