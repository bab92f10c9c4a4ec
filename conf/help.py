"""What --help prints, read from this package's YAML files, so that it cannot go stale.

Only `yaml` is needed for it: a command's help does not wait for hydra.
"""

from collections.abc import Iterator, Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from textwrap import wrap
from typing import Any

import yaml

Plain = dict[str, Any]


def command_name(config_name: str) -> str:
    """The console script that a primary config belongs to."""
    name: str = _primary(config_name)["hydra"]["help"]["app_name"]
    return name


def help_text(config_name: str) -> str:
    """What --help prints: purpose, groups, settings and examples, all from the package's files."""
    about, command = _primary(config_name)["hydra"]["help"], command_name(config_name)
    return "\n".join(
        [
            f"{command} [setting=value | group=choice] ...",
            "",
            about["header"].rstrip(),
            *_groups_text(config_name, command),
            "",
            "Settings (with their defaults):",
            *(f"  {line}" for line in _setting_lines(config_name)),
            "",
            "Options:",
            "  --cfg job    show the whole config that the other arguments make, and end",
            "  --multirun   run once for each of several values, as in seed=0,1,2",
            "  --version, --help",
            "",
            "Examples:",
            *(f"  {line}" for line in about["footer"].splitlines()),
        ]
    )


def choices(group: str) -> list[str]:
    """The presets of a config group."""
    entries = (files("conf") / group).iterdir()
    return sorted(e.name.removesuffix(".yaml") for e in entries if e.name.endswith(".yaml"))


def group_defaults(config_name: str) -> dict[str, list[str]]:
    """Config group -> presets that are taken by default, of a primary config."""
    defaults = _primary(config_name)["defaults"]
    pairs = [pair for item in defaults if isinstance(item, Mapping) for pair in item.items()]
    return {group: [name] if isinstance(name, str) else name for group, name in pairs}


def setting_names(config_name: str) -> list[str]:
    """Dotted names of all settings and groups of a command, as its defaults compose them."""
    names = [name for name in _primary(config_name) if name not in ("defaults", "hydra")]
    for group, chosen in group_defaults(config_name).items():
        content = _load(files("conf") / group / f"{chosen[0]}.yaml")
        names.append(group)
        names.extend(f"{group}.{key}" for key in content if key != "defaults")
    return names


def _groups_text(config_name: str, command: str) -> Iterator[str]:
    defaults = group_defaults(config_name)
    if not defaults:
        return
    yield ""
    yield "Config groups (* is the default):"
    for group, default in defaults.items():
        names = [f"{name}*" if name in default else name for name in choices(group)]
        yield from wrap(
            f"{group:<8} {', '.join(names)}", 96, initial_indent="  ", subsequent_indent=" " * 11
        )
    if "agent" in defaults:
        yield "Their values are settings too, as in agent.noise=0.1, tokens.shapes=[square,square];"
    yield f"`{command} --cfg job` shows all of their values."


def _setting_lines(config_name: str) -> list[str]:
    """The lines of a primary config that are neither its defaults list nor hydra's."""
    lines, shown = [], False
    for line in (files("conf") / f"{config_name}.yaml").read_text("utf-8").splitlines():
        if line[:1].isalpha():
            shown = not line.startswith(("defaults:", "hydra:"))
        if shown and line.strip():
            lines.append(line)
    return lines


def _primary(config_name: str) -> Plain:
    return _load(files("conf") / f"{config_name}.yaml")


def _load(file: Traversable) -> Plain:
    content: Plain = yaml.safe_load(file.read_text("utf-8"))
    return content
