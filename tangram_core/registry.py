"""Tasks and agents by their names: those that come with the package, and those of others.

Another package announces its own as entry points of the groups `tangram_rl.tasks` and
`tangram_rl.agents`.
"""

from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Literal

from tangram_core.errors import ConfigError

if TYPE_CHECKING:  # a command line that is wrong need not wait for numpy
    from tangram_core.agent import Agent
    from tangram_core.task import Task

Role = Literal["task", "agent"]
TASK, AGENT = "task", "agent"  # the sections that every run has
KIND = "kind"  # the setting that names it, in the section of its role
OURS: dict[Role, dict[str, str]] = {
    "task": {
        "place": "tangram_tasks.place:Place",
        "fill": "tangram_tasks.fill:Fill",
        "gym": "tangram_tasks.gym.task:Gym",
    },
    "agent": {
        "scene": "tangram_agent.agents.scene.agent:Scene",
        "pair": "tangram_agent.agents.pair.agent:Pair",
        "outline": "tangram_agent.agents.outline.agent:Outline",
        "goal": "tangram_agent.agents.goal.agent:Goal",
    },
}


def find_task(kind: str) -> "type[Task]":
    """The class of a task.

    Raises:
        ConfigError: there is none of this name, or it is no task.
    """
    from tangram_core.task import Task  # noqa: PLC0415

    return _found("task", kind, Task)


def find_agent(kind: str) -> "type[Agent]":
    """The class of an agent; errors as for `find_task`."""
    from tangram_core.agent import Agent  # noqa: PLC0415

    return _found("agent", kind, Agent)


def _found(role: Role, kind: str, base: type[Any]) -> type[Any]:
    place, others = OURS[role].get(kind), dict[str, str]()
    if place is None:
        others = {one.name: one.value for one in entry_points(group=f"tangram_rl.{role}s")}
        place = others.get(kind)
        if place is None:
            known = ", ".join([*OURS[role], *others])
            raise ConfigError(f"{role}.{KIND}={kind}: there is no such {role}: choose from {known}")
    module, _, name = place.partition(":")
    found = getattr(import_module(module), name, None)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ConfigError(f"{role}.{KIND}={kind}: {place} is no {base.__name__}: mend its package")
    return found
