"""Code of the user's own: which settings name it, and that only a command line has it loaded."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

NAMES = ("task.kind", "agent.kind", "reward.name")  # settings that may name path/to/file.py:Name


def own_code(name: str) -> tuple[Path, str] | None:
    """File and name of what is in it, where a setting is code of the user's own."""
    path, _, what = name.rpartition(":")
    code = path.endswith(".py") and what.isidentifier()
    return (Path(path).expanduser(), what) if code else None


def code_of(resolved: Mapping[str, Any]) -> dict[str, str]:
    """The settings of a run that are code, which each of its commands must name itself."""
    found = {}
    for setting in NAMES:
        section, _, key = setting.partition(".")
        value = resolved.get(section, {}).get(key, "")
        if isinstance(value, str) and own_code(value) is not None:
            found[setting] = value
    return found
