"""What a master and its workers must agree on: a task and an agent, from plain mappings."""

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
        task, agent: the two.
        task_kind, agent_kind: the names that they go by.
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
        """What its episodes are made of."""
        return self.task.spec

    @property
    def kinds(self) -> dict[str, dict[str, str]]:
        """How the two are named in a config; by its content too, what stands in a file."""
        return {TASK: named("task", self.task_kind), AGENT: named("agent", self.agent_kind)}

    @property
    def sections(self) -> dict[str, Settings | None]:
        """Section of the settings -> what it holds; nothing where it only names the kind."""
        own = {TASK: None, AGENT: None}
        return own | _sections(self.task) | _sections(self.agent)

    def config(self) -> dict[str, Any]:
        """The sections of a config that makes this setup."""
        held = {
            n: {} if one is None else asdict(cast("Any", one)) for n, one in self.sections.items()
        }
        return {name: self.kinds.get(name, {}) | held[name] for name in held}

    def fingerprints(self) -> dict[str, str]:
        """A digest of each section: two processes with the same ones play the same task."""
        return {name: _digest(content) for name, content in self.contents().items()}

    def task_digest(self) -> str:
        """A digest of all sections but the agent's, which may change in the middle of a run."""
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
        """The sections in which another setup, known by its contents, is not this one.

        Only settings that both know are compared, so that a run outlives a version with more of
        them: what is new does by default what was done before.
        """
        own = self.contents()
        known = own | contents if isinstance(contents, dict) else {}
        return sorted(name for name in own if not _agree(own[name], known.get(name)))

    def meant_otherwise(self, contents: object, section: str = AGENT) -> list[str]:
        """The settings by which networks of another setup are not networks of this one.

        They may have the same shapes: what they see, give and learn from is another thing.
        """
        other = contents.get(section) if isinstance(contents, dict) else None
        own, holds = self.contents().get(section, {}), self.sections.get(section)
        known = own | other if isinstance(other, dict) else own
        declared = [] if holds is None else declared_fields(type(holds))
        parts = {KIND: NETWORK} | {one.name: one.metadata[KEY].part for one in declared}
        odd = [name for name in own if parts.get(name) == NETWORK]
        return [f"{section}.{name}" for name in odd if own[name] != known[name]]


def attribute(section: str) -> str:
    """The field of a task or agent that holds a section: `config` is the one of its role."""
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
    """The sections of a resolved config that make its setup.

    Raises:
        ConfigError: it names no task or agent, or one that there is not.
    """
    task, agent = find_task(_kind(config, TASK)), find_agent(_kind(config, AGENT))
    return tuple(dict.fromkeys((TASK, *task.sections, AGENT, *agent.sections)))


def make_setup(config: Mapping[str, Any]) -> Setup:
    """The setup in the sections of a resolved config.

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
            f"the config names no {role}: it must have {role}.{KIND}; a config may lack it of an "
            "older version (CHANGELOG.md)"
        )
    return kind


def _made(kind: type[Made], config: Mapping[str, Any], role: Role) -> Made:
    """A task or an agent of its sections."""
    sections: Mapping[str, type[Settings]] = kind.sections  # type: ignore[attr-defined]
    said = named(role, config[role][KIND])
    wanted = config[role].get(SHA256)
    if SHA256 in said and wanted not in (None, said[SHA256]):
        raise ConfigError(
            f"{role}={said[KIND]}: the file has sha256 {said[SHA256]}, and the settings of "
            f"the run want {wanted}: name the file that it began with, or begin a new run"
        )
    own = {name: value for name, value in config[role].items() if name not in said}
    if role not in sections and own:
        raise ConfigError(f"there is no setting {role}.{min(own)}: delete it")
    given = {name: own if name == role else config[name] for name in sections}
    return kind(**{attribute(n): from_mapping(c, given[n], n) for n, c in sections.items()})


def from_mapping(kind: type[Made], mapping: Mapping[str, Any], section: str = "") -> Made:
    """A settings dataclass from a plain mapping; unknown keys and wrong types are refused.

    Args:
        kind: the dataclass.
        mapping: name -> value.
        section: that it stands in, for errors.

    Raises:
        ConfigError: names the key and what is wrong with it.
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
    """A type in plain words."""
    if get_origin(kind) is tuple:
        return f"a list, each {_wanted(get_args(kind)[0])}"
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
    return words.get(kind, str(kind))


def _check_names(kind: type[Any], mapping: Mapping[str, Any], group: str) -> None:
    """Refuse unknown names, and what is no list where one is expected.

    A text would be taken letter by letter.
    """
    hints = get_type_hints(kind)
    for name, value in mapping.items():
        if name not in hints:
            raise ConfigError(
                f"there is no setting {group}{name}: delete it; CHANGELOG.md says what became of "
                "one of an older version"
            )
        if get_origin(hints[name]) is tuple and not isinstance(value, list | tuple):
            full = f"{group}{name}"
            raise ConfigError(f"{full} must be a list, as in {full}=[...], got {value!r}")
        if is_dataclass(hints[name]) and isinstance(value, Mapping):
            _check_names(cast("type[Any]", hints[name]), value, f"{group}{name}.")


def _as_float(value: object) -> object:
    """Whole numbers are welcome where a float is expected; texts and booleans are not."""
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value
