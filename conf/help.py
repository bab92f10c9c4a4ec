"""The text of --help, made from the declarations of settings, so that it is always up to date.

Hydra is not loaded, so that --help is instant.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import Field
from importlib.resources import files
from pathlib import Path
from textwrap import wrap
from typing import Any

from conf.commands import COMMANDS, USUAL, Command, declared, laid_over, plain_default
from conf.kinds import Kinds
from tangram_core.settings import KEY, PLAY, Declaration, told

WIDTH = 96


def help_text(config_name: str, folder: str | None = None, kinds: Kinds = USUAL) -> str:
    """The text of --help: purpose, groups, settings and examples.

    Args:
        config_name: key of the command in `COMMANDS`.
        folder: folder of the user's own presets.
        kinds: task and agent of the command line.
    """
    command = COMMANDS[config_name]
    choice = " | group=choice" if command.groups else ""
    inside = ["  --help sim   print the settings of a group"] if command.sections(kinds) else []
    return "\n".join(
        [
            f"{command.name} [setting=value{choice}] ...",
            "",
            command.about,
            *_groups_text(command, folder, kinds),
            "",
            "Settings (with their defaults):",
            *(f"  {line}" for line in _setting_lines(command)),
            *_over_text(command),
            "",
            "Options:",
            "  --cfg job    print the whole config that the other arguments give, and exit",
            "  --multirun   run once for each value in a list, as in seed=0,1,2",
            "  --config-dir DIR  use your own presets, as in DIR/tokens/mine.yaml for tokens=mine",
            *inside,
            "  --version, --help",
            "",
            "Examples:",
            *(f"  {line}" for line in command.examples),
        ]
    )


def group_help(
    config_name: str, group: str, folder: str | None = None, kinds: Kinds = USUAL
) -> str:
    """The text of `--help GROUP`: the presets and settings of the group."""
    if group in COMMANDS[config_name].over:
        first = f"{group}.name=value replaces the value of the run; null keeps it"
        lines = [_line(own, "null", group) for own in playable(group).values()]
    else:
        first = f"{group}={'|'.join(choices(group, folder))}"
        every = declared(kinds.sections()[group])
        lines = [_line(own, told_default(plain_default(own)), group) for own in every]
    return "\n".join([first, "", *lines])


def playable(group: str) -> dict[str, "Field[Any]"]:
    """Full name -> setting of a group that may be changed when a trained run plays."""
    every = laid_over(group).items()
    return {f"{group}.{name}": own for name, own in every if own.metadata[KEY].part == PLAY}


def choices(group: str, folder: str | None = None) -> list[str]:
    """Names of the presets of a config group.

    Args:
        group: name of the group.
        folder: folder of the user's own presets.
    """
    places = [files("conf") / group, *([] if folder is None else [Path(folder) / group])]
    entries = [entry.name for place in places if place.is_dir() for entry in place.iterdir()]
    return sorted(name.removesuffix(".yaml") for name in entries if name.endswith(".yaml"))


def group_defaults(command: Command, kinds: Kinds) -> dict[str, list[str]]:
    """Config group -> default presets of a command."""
    groups = command.chosen(kinds).items()
    return {group: [name] if isinstance(name, str) else name or [] for group, name in groups}


def setting_names(config_name: str, kinds: Kinds = USUAL) -> list[str]:
    """Full names of all settings and groups of a command."""
    command = COMMANDS[config_name]
    names = [*command.defaults(), *command.chosen(kinds)]
    names += [
        f"{group}.{key}" for group, section in command.sections(kinds).items() for key in section
    ]
    return names


def told_default(value: Any) -> str:
    """A default as text, as on a command line."""
    if isinstance(value, list):
        return f"[{','.join(map(told_default, value))}]"
    if isinstance(value, Mapping):
        return f"{{{','.join(f'{name}:{told_default(one)}' for name, one in value.items())}}}"
    return told(value)


def _groups_text(command: Command, folder: str | None, kinds: Kinds) -> Iterator[str]:
    if not command.groups:
        return
    yield ""
    yield "Config groups and their presets, chosen as in sim=kinematic (* is the default):"
    for group, default in group_defaults(command, kinds).items():
        names = [f"{n}*" if n in default else n for n in choices(group, folder)]
        names += ["or path/to/file.py:Name"] if group in kinds.named() else []
        yield from wrap(
            f"{group:<8} {', '.join(names)}", WIDTH, initial_indent="  ", subsequent_indent=" " * 11
        )
    if "agent" in command.groups:
        yield "Set single values as in agent.noise=0.1 or tokens.shapes=[square,square]."
    yield f"`{command.name} --cfg job` prints all values."


def _over_text(command: Command) -> Iterator[str]:
    if not command.over:
        return
    yield ""
    sections = ", ".join(command.over)
    yield f"Settings of {sections} can replace those of the run, as in agent.reapply=1."
    yield "Settings for learning only, and settings that the weights depend on, are refused."


def _setting_lines(command: Command) -> Iterator[str]:
    defaults = command.defaults()
    for own in command.fields():
        yield _line(own, told_default(defaults[own.name]))


def _line(own: "Field[Any]", default: str, group: str = "") -> str:
    what: Declaration = own.metadata[KEY]
    name = f"{group}.{own.name}" if group else own.name
    choice = f" ({_either(what.choices)})" if what.choices else ""
    unit = f" ({what.unit})" if what.unit else ""
    return f"{name}: {default}  # {what.help}{choice}{unit}"


def _either(choices: Sequence[str]) -> str:
    return f"{', '.join(choices[:-1])} or {choices[-1]}"
