"""Settings that are called like a config group, such as tokens of tangram-play.

Hydra takes `tokens=square` for the choice of a preset wherever there are presets of tokens, but not
a mapping: so such values travel as `tokens={name:square}`.
"""

from collections.abc import Sequence
from importlib.resources import files

from conf.commands import COMMANDS, Plain


def plain_names(config_name: str) -> list[str]:
    """The settings of a command with the name of a group that the command does not have."""
    command = COMMANDS[config_name]
    own = [name for name in command.defaults() if name not in command.groups]
    return [name for name in own if (files("conf") / name).is_dir()]


def hidden(arguments: Sequence[str], config_name: str) -> list[str]:
    """The arguments with settings that share a group's name written so that hydra takes them."""
    names = plain_names(config_name)
    split = [argument.partition("=") for argument in arguments]
    return [
        f"{key}={{name:{value or 'null'}}}" if sign and key in names else key + sign + value
        for key, sign, value in split
    ]


def revealed(settings: Plain, config_name: str) -> Plain:
    """The settings of a composed config, with what `hidden` did undone."""
    own = {name: settings[name] for name in plain_names(config_name)}
    return settings | {n: v["name"] for n, v in own.items() if isinstance(v, dict) and "name" in v}
