"""The task and the agent that a command line names, and with them its sections of settings.

They are found before hydra composes the config: a preset, or one in its defaults, has `kind: NAME`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml

from tangram_core.errors import ConfigError
from tangram_core.registry import AGENT, OURS, TASK, find_agent, find_task
from tangram_core.run.code import KIND, unquoted
from tangram_core.run.service import ServiceConfig
from tangram_core.settings import Settings

Sections = dict[str, type[Settings] | None]
MAX_STEPS = 16  # longest chain of presets, each in the defaults of the one before


@dataclass(frozen=True)
class Kinds:
    """The names of a task and of an agent."""

    task: str = "place"
    agent: str = "pair"

    def sections(self) -> Sections:
        """Section -> dataclass of its settings; None if the section has only `kind`."""
        task, agent = find_task(self.task).sections, find_agent(self.agent).sections
        return {TASK: None, **task, AGENT: None, **agent, "service": ServiceConfig}

    def named(self) -> dict[str, str]:
        """Section -> value of its `kind`."""
        return {"task": self.task, "agent": self.agent}


def every_kind(group: str) -> list[Kinds]:
    """All kinds of tangram-rl for the group task or agent; for other groups the default kinds."""
    if group == TASK:
        return [Kinds(task=kind) for kind in OURS["task"]]
    return [Kinds(agent=kind) for kind in OURS["agent"]] if group == AGENT else [Kinds()]


def kinds_of(
    arguments: Sequence[str], folder: str | None = None, stored: dict[str, Any] | None = None
) -> Kinds:
    """The task and the agent that the arguments of a command name.

    Args:
        arguments: arguments of the command line.
        folder: folder of the user's own presets.
        stored: config of the run in `from_config`.

    Raises:
        ConfigError: a sweep has presets of several kinds.
    """
    usual = Kinds()
    found = {role: _chosen(role, arguments, folder, stored) for role in (TASK, AGENT)}
    return Kinds(found[TASK] or usual.task, found[AGENT] or usual.agent)


def with_usual_agent(arguments: Sequence[str], folder: str | None = None) -> list[str]:
    """The arguments of a new run, with the task's default agent if they name only a task."""
    given = {one.lstrip("+").partition("=")[0] for one in arguments if "=" in one}
    task = _chosen(TASK, arguments, folder, None)
    if task in (None, Kinds().task) or given & {AGENT, f"{AGENT}.{KIND}", "from_config"}:
        return [*arguments]
    return [*arguments, f"{AGENT}={find_task(task).agent}"]


def _chosen(
    role: str, arguments: Sequence[str], folder: str | None, stored: dict[str, Any] | None
) -> str | None:
    given = [a.partition("=") for a in arguments if "=" in a]
    exact = [value for name, _, value in given if name.lstrip("+") == f"{role}.{KIND}"]
    if exact:
        return unquoted(exact[-1])
    presets = [value for name, _, value in given if name.lstrip("+") == role]
    if presets:
        kinds = {_kind(role, preset, folder) for preset in presets[-1].split(",")}
        if len(kinds) > 1:
            raise ConfigError(
                f"{role}={presets[-1]}: a sweep takes presets of one kind: start a sweep for each"
            )
        return kinds.pop()
    section = None if stored is None else stored.get(role)
    kind = section.get(KIND) if isinstance(section, dict) else None
    return kind if isinstance(kind, str) else None


def _kind(role: str, preset: str, folder: str | None) -> str | None:
    """The kind in a preset, or in one of its defaults; None: there is none."""
    for _ in range(MAX_STEPS):
        content = _read(role, preset, folder)
        if isinstance(content.get(KIND), str):
            return str(content[KIND])
        before = [one for one in content.get("defaults", []) if isinstance(one, str)]
        before = [one for one in before if one != "_self_"]
        if not before:
            return None
        preset = before[-1]
    return None


def _read(role: str, preset: str, folder: str | None) -> dict[str, Any]:
    """The content of a preset; empty if it is missing or broken, which is reported later."""
    places = [files("conf") / role, *([] if folder is None else [Path(folder) / role])]
    for place in places:
        path = place / f"{preset}.yaml"
        if path.is_file():
            try:
                content = yaml.safe_load(path.read_text("utf-8"))
            except (yaml.YAMLError, ValueError, RecursionError):
                return {}
            return content if isinstance(content, dict) else {}
    return {}
