"""Tasks and agents by name: from tangram-rl, from other packages and from files.

Another package announces its tasks and agents as entry points of the groups `tangram_rl.tasks` and
`tangram_rl.agents`. A class in a file is named path/to/file.py:Name; `load_own` must load it first.
"""

from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from tangram_core.errors import ConfigError
from tangram_core.run.code import KIND, load_code, own_code, read_code, where
from tangram_core.settings import Settings

if TYPE_CHECKING:  # a wrong command line fails without loading numpy
    from tangram_core.agent import Agent
    from tangram_core.task import Task

Role = Literal["task", "agent"]
TASK, AGENT = "task", "agent"  # the sections that every run has
SHA256 = "sha256"  # setting beside `kind`: digest of the file
OURS: dict[Role, dict[str, str]] = {
    "task": {
        "place": "tangram_tasks.place:Place",
        "fill": "tangram_tasks.fill:Fill",
        "gym": "tangram_tasks.gym.task:Gym",
        "push": "tangram_tasks.push.task:Push",
    },
    "agent": {
        "scene": "tangram_agent.agents.scene.agent:Scene",
        "pair": "tangram_agent.agents.pair.agent:Pair",
        "outline": "tangram_agent.agents.outline.agent:Outline",
        "goal": "tangram_agent.agents.goal.agent:Goal",
        "push": "tangram_agent.agents.push.agent:Pushing",
    },
}


class Own(NamedTuple):
    """A task or an agent from a user's file."""

    kind: type[Any]
    named: str  # absolute/path/to/file.py:Name
    sha256: str


_own: dict[tuple[Role, str], Own] = {}  # role, and path:Name or Name


def find_task(kind: str) -> "type[Task]":
    """The class of a task.

    Raises:
        ConfigError: there is no such task, the class is no task, or its file was not named on the
            command line.
    """
    return _own_of("task", kind).kind if own_code(kind) else _found("task", kind)


def find_agent(kind: str) -> "type[Agent]":
    """The class of an agent; errors as in `find_task`."""
    return _own_of("agent", kind).kind if own_code(kind) else _found("agent", kind)


def announced(role: Role) -> dict[str, str]:
    """Tasks or agents of other packages: name -> module:Class."""
    return {one.name: one.value for one in entry_points(group=f"tangram_rl.{role}s")}


def load_own(role: Role, given: str) -> None:
    """Load a task or an agent from a file that a command line or a program names.

    Args:
        role: task or agent.
        given: path/to/file.py:Name.

    Raises:
        ConfigError: the class cannot be loaded, or is no task or agent.
    """
    own = own_code(given)
    if own is None:
        raise ConfigError(f"{role}={given}: name it as in {role}=path/to/file.py:Name")
    path, name = own
    source, digest = read_code(role, given, path)
    found = load_code(role, given, path, name, source)
    kind, whole = _checked(f"{role}={given}", role, found), f"{path.absolute()}:{name}"
    _own[role, name] = _own[role, whole] = Own(kind, whole, digest)


def named(role: Role, kind: str) -> dict[str, str]:
    """The settings that name a kind; for one in a file the absolute path and the file's digest.

    Raises:
        ConfigError: the file was not named on the command line.
    """
    if own_code(kind) is None:
        return {KIND: kind}
    own = _own_of(role, kind)
    return {KIND: own.named, SHA256: own.sha256}


def identity(role: Role, kind: str) -> dict[str, str]:
    """As `named`, without the path of the file, to compare processes on different machines."""
    said = named(role, kind)
    return said | {KIND: said[KIND].rpartition(":")[2]} if SHA256 in said else said


def _own_of(role: Role, kind: str) -> Own:
    """The loaded class by path, or by name if the path differs on this machine."""
    path, name = own_code(kind) or (Path(), "")
    found = _own.get((role, f"{path.absolute()}:{name}"), _own.get((role, name)))
    if found is None:
        raise ConfigError(
            f"the settings of the run name code, {kind}, which is not loaded unless you name it: "
            f"add {role}={kind} if you trust it"
        )
    return found


def _found(role: Role, kind: str) -> type[Any]:
    place, others = OURS[role].get(kind), dict[str, str]()
    if place is None:
        others = announced(role)
        place = others.get(kind)
        if place is None:
            known = ", ".join([*OURS[role], *others])
            raise ConfigError(f"{role}.{KIND}={kind}: there is no such {role}: choose from {known}")
    module, _, name = place.partition(":")
    try:
        found: Any = getattr(import_module(module), name, None)
    except Exception as error:
        if kind in OURS[role]:
            raise
        raise ConfigError(f"{role}={kind} ({place}) cannot be loaded: {where(error)}") from error
    return found if kind in OURS[role] else _checked(f"{role}={kind} ({place})", role, found)


def _checked(what: str, role: Role, found: object) -> type[Any]:
    """The class, if it can be made from settings; see the docstrings of `Task` and `Agent`."""
    from tangram_core.agent import Agent  # noqa: PLC0415 - a wrong command line needs no numpy
    from tangram_core.task import Task  # noqa: PLC0415

    base: type[Any] = Task if role == "task" else Agent
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ConfigError(f"{what} is no {base.__name__}: derive its class from {base.__module__}")
    lacking = sorted(getattr(found, "__abstractmethods__", ()))
    if lacking:
        raise ConfigError(f"{what} has no {', '.join(lacking)}: see {base.__module__}")
    kind: Any = found
    held = kind.__dataclass_fields__
    if not isinstance(kind.sections, Mapping):
        raise ConfigError(f"{what}: sections must be a dict, section -> dataclass of Settings")
    for name, section in kind.sections.items():
        if not (isinstance(section, type) and issubclass(section, Settings)):
            raise ConfigError(f"{what}: sections[{name!r}] is no dataclass of Settings")
        if section.section != name:
            raise ConfigError(f"{what}: {section.__name__} must say section={name!r}")
        if name == role and {KIND, SHA256} & {*vars(section)}:
            raise ConfigError(f"{what}: {section.__name__} must not declare {KIND} or {SHA256}")
        attribute = "config" if name == role else name
        if attribute not in held:
            raise ConfigError(f"{what} has no field {attribute}: declare it in a @dataclass")
    return found
