"""The task and the agent of a run, made from a config; master and workers compare them."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

import dacite

from tangram_core.agent import Agent
from tangram_core.errors import ConfigError
from tangram_core.registry import (
    AGENT,
    SHA256,
    TASK,
    Role,
    find_agent,
    find_task,
    identity,
    named,
)
from tangram_core.run.code import KIND
from tangram_core.settings import KEY, NETWORK, Settings, declared_fields, told
from tangram_core.spec import EpisodeSpec
from tangram_core.task import Task

Made = TypeVar("Made")


@dataclass(frozen=True)
class Setup:
    """The task and the agent of one run.

    Attributes:
        task, agent: the task and the agent.
        task_kind, agent_kind: their names in `task.kind` and `agent.kind`.
    """

    task: Task
    agent: Agent
    task_kind: str
    agent_kind: str

    def __post_init__(self) -> None:
        """Refuse an agent that cannot play the task; ConfigError names the setting."""
        self.agent.check(self.task)

    @property
    def spec(self) -> EpisodeSpec:
        """Names, shapes and bounds of the arrays in an episode of the task."""
        return self.task.spec

    @property
    def kinds(self) -> dict[str, dict[str, str]]:
        """Section -> the settings that name the task or the agent; see `named`."""
        return {TASK: named("task", self.task_kind), AGENT: named("agent", self.agent_kind)}

    @property
    def sections(self) -> dict[str, Settings | None]:
        """Section -> its settings; None if the section only names the kind."""
        own = {TASK: None, AGENT: None}
        return own | _sections(self.task) | _sections(self.agent)

    def config(self) -> dict[str, Any]:
        """The sections of a config from which `make_setup` makes this setup."""
        held = {
            n: {} if one is None else asdict(cast("Any", one)) for n, one in self.sections.items()
        }
        return {name: self.kinds.get(name, {}) | held[name] for name in held}

    def fingerprints(self) -> dict[str, str]:
        """Section -> digest; processes with equal digests have the same task and agent."""
        return {name: _digest(content) for name, content in self.contents().items()}

    def task_digest(self) -> str:
        """A digest of all sections except the agent's, which may change during a run."""
        digests = [value for name, value in sorted(self.fingerprints().items()) if name != AGENT]
        return hashlib.sha256("".join(digests).encode()).hexdigest()[:16]

    def contents(self) -> dict[str, Any]:
        """Each section as JSON values, for a checkpoint; see `Task.identity`."""
        kinds = {TASK: identity("task", self.task_kind), AGENT: identity("agent", self.agent_kind)}
        every = self.task.identity() | self.agent.identity()
        joined = {n: kinds.get(n, {}) | every.get(n, {}) for n in kinds.keys() | every.keys()}
        plain: dict[str, Any] = json.loads(json.dumps(joined, sort_keys=True))
        return plain

    def differences(self, contents: object) -> list[str]:
        """Names of the sections that differ from those of another setup.

        Only settings that both setups have are compared. So a run can go on with a newer version,
        whose new settings have defaults that change nothing.

        Args:
            contents: `contents()` of the other setup, for example from a checkpoint.
        """
        own = self.contents()
        known = own | contents if isinstance(contents, dict) else {}
        return sorted(name for name in own if not _agree(own[name], known.get(name)))

    def meant_otherwise(self, contents: object, section: str = AGENT) -> list[str]:
        """Names of the settings that make the networks of another setup unusable in this one.

        The shapes may be equal, but inputs, outputs or the learned values have another meaning.
        """
        other = contents.get(section) if isinstance(contents, dict) else None
        own, holds = self.contents().get(section, {}), self.sections.get(section)
        known = own | other if isinstance(other, dict) else own
        declared = [] if holds is None else declared_fields(type(holds))
        parts = {KIND: NETWORK} | {one.name: one.metadata[KEY].part for one in declared}
        odd = [name for name in own if parts.get(name) == NETWORK]
        return [f"{section}.{name}" for name in odd if own[name] != known[name]]


def attribute(section: str) -> str:
    """The field of a task or an agent that holds a section: `config` for task and agent."""
    return "config" if section in (TASK, AGENT) else section


def _sections(owner: Task | Agent) -> dict[str, Settings | None]:
    return {name: getattr(owner, attribute(name)) for name in owner.sections}


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _agree(one: object, other: object) -> bool:
    """Whether two JSON values are equal in all keys that both have."""
    if isinstance(one, dict) and isinstance(other, dict):
        return all(_agree(one[name], other[name]) for name in one.keys() & other.keys())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_agree, one, other))
    return one == other


def section_names(config: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the sections in a resolved config that its task and agent need.

    Raises:
        ConfigError: the config names no task or agent, or an unknown one.
    """
    task, agent = find_task(_kind(config, TASK)), find_agent(_kind(config, AGENT))
    return tuple(dict.fromkeys((TASK, *task.sections, AGENT, *agent.sections)))


def make_setup(config: Mapping[str, Any]) -> Setup:
    """Make the setup of a resolved config.

    Raises:
        ConfigError: a section is missing, a key is unknown, or a value has a wrong type or range.
    """
    kinds = _kind(config, TASK), _kind(config, AGENT)
    task, agent = find_task(kinds[0]), find_agent(kinds[1])
    missing = [name for name in section_names(config) if name not in config]
    if missing:
        raise ConfigError(f"the config has no section {', '.join(missing)}")
    return Setup(_made(task, config, "task"), _made(agent, config, "agent"), *kinds)


def _kind(config: Mapping[str, Any], role: str) -> str:
    section = config.get(role)
    kind = section.get(KIND) if isinstance(section, Mapping) else None
    if not isinstance(kind, str):
        raise ConfigError(
            f"the config names no {role}: it must have {role}.{KIND}; a config of an older version "
            "may lack it (CHANGELOG.md)"
        )
    return kind


def _made(kind: type[Made], config: Mapping[str, Any], role: Role) -> Made:
    """A task or an agent from its sections."""
    sections: Mapping[str, type[Settings]] = kind.sections  # type: ignore[attr-defined]
    said = named(role, config[role][KIND])
    wanted = config[role].get(SHA256)
    if SHA256 in said and wanted not in (None, said[SHA256]):
        raise ConfigError(
            f"{role}={said[KIND]}: the file has sha256 {said[SHA256]}, and the settings of "
            f"the run want {wanted}: name the file that the run began with, or begin a new run"
        )
    own = {name: value for name, value in config[role].items() if name not in said}
    if role not in sections and own:
        raise ConfigError(f"there is no setting {role}.{min(own)}: delete it")
    given = {name: own if name == role else config[name] for name in sections}
    return kind(**{attribute(n): from_mapping(c, given[n], n) for n, c in sections.items()})


def from_mapping(kind: type[Made], mapping: Mapping[str, Any], section: str = "") -> Made:
    """Make a settings dataclass from a plain mapping.

    Args:
        kind: the dataclass.
        mapping: name -> value.
        section: name of the section, for errors.

    Raises:
        ConfigError: a key is unknown or a value has a wrong type; names the key.
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"the section {section} must be a mapping, got {mapping!r}")
    _check_names(kind, mapping, f"{section}." if section else "")
    rules = dacite.Config(strict=True, cast=[tuple], type_hooks={float: _as_float})
    try:
        made: Made = dacite.from_dict(cast("Any", kind), mapping, rules)
        return made
    except dacite.DaciteError as error:
        if section and isinstance(error, dacite.DaciteFieldError):
            error.update_path(section)
        if isinstance(error, dacite.WrongTypeError):
            wanted = _wanted(cast("Any", error.field_type))
            got = told(error.value)
            raise ConfigError(f"{error.field_path} must be {wanted}, got {got}") from None
        raise ConfigError(f"wrong config: {error}") from None


def _wanted(kind: Any) -> str:
    """The name of a type in plain words."""
    if get_origin(kind) is tuple:
        return f"a list, each {_wanted(get_args(kind)[0])}"
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
    return words.get(kind, str(kind))


def _check_names(kind: type[Any], mapping: Mapping[str, Any], group: str) -> None:
    """Refuse unknown names, and a text or number where a list is expected.

    A text would become a list of its letters.
    """
    hints = get_type_hints(kind)
    for name, value in mapping.items():
        if name not in hints:
            raise ConfigError(
                f"there is no setting {group}{name}: delete it; CHANGELOG.md tells what replaces "
                "settings of older versions"
            )
        if get_origin(hints[name]) is tuple and not isinstance(value, list | tuple):
            full = f"{group}{name}"
            raise ConfigError(f"{full} must be a list, as in {full}=[...], got {value!r}")
        if is_dataclass(hints[name]) and isinstance(value, Mapping):
            _check_names(cast("type[Any]", hints[name]), value, f"{group}{name}.")


def _as_float(value: object) -> object:
    """An integer as a float where a float is expected; other values are returned unchanged."""
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value
