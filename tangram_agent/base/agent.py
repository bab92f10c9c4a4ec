"""Base class of agents of tokens; does not import torch."""

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
    """An agent that learns from a replay buffer; subclasses add `sections`, `actor`, `learns`."""

    config: LearningConfig
    net: NetConfig

    @property
    def pace(self) -> Pace:
        """The pace in the settings."""
        return Pace(self.config.updates_per_transition, self.config.learning_starts)

    def check(self, task: Task) -> None:
        """Refuse a replay buffer that is too small for one episode."""
        capacity, horizon = self.config.replay_capacity, task.spec.horizon
        if capacity < horizon:
            raise ConfigError(
                f"agent.replay_capacity must hold one episode, at least {horizon}, got {capacity}"
            )

    @abstractmethod
    def learns(self) -> "Callable[[Any, Any, int, str, bool], TokenLearner]":
        """The learner's class; it takes the agent, a task, a seed, a device and `compiled`."""

    def learner(
        self, task: Task, seed: int, device: str = "cpu", *, compiled: bool = False
    ) -> "TokenLearner":
        """See `Agent.learner`."""
        return self.learns()(self, task, seed, device, compiled)

    def facts(self) -> Json:
        """Name of the preset and kind of network, for reports."""
        return {"agent": self.config.name, "net": self.net.kind}


def seen_tokens(task: Task, kind: str) -> Place:
    """The task as one of tokens whose target shows its pieces.

    Raises:
        ConfigError: it is another task; names the agent (`kind`) and the remedy.
    """
    if not isinstance(task, Place) or task.outlines:
        raise ConfigError(
            f"agent.kind={kind} needs tokens and the pieces of a target: set task=place, or "
            "another agent, such as agent=goal for fields of numbers"
        )
    return task
