"""What agents of tokens ask of a task."""

from tangram_core.errors import ConfigError
from tangram_core.task import Task
from tangram_tasks.place import Place


def seen_tokens(task: Task, kind: str) -> Place:
    """The task, if it is one of tokens whose target is seen piece by piece.

    Raises:
        ConfigError: names the agent and what to set.
    """
    if not isinstance(task, Place) or task.outlines:
        raise ConfigError(
            f"agent.kind={kind} plays tokens whose target it sees: set task=place, or another agent"
        )
    return task


def check_capacity(task: Place, capacity: int) -> None:
    """Raise ConfigError unless a replay of so many transitions holds an episode."""
    if capacity < task.horizon:
        raise ConfigError(
            f"agent.replay_capacity must hold an episode, {task.horizon} actions, got {capacity}"
        )
