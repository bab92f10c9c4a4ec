"""Checks a command's arguments and presets before hydra reads them, and explains hydra's errors."""

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

import yaml

from conf.commands import COMMANDS, GROUPS
from conf.help import choices, setting_names
from conf.kinds import Kinds
from tangram_core.errors import ConfigError

CFG_KINDS = ("job", "hydra", "all")
FLAGS = ("--cfg", "--multirun", "-m")
OWN_PRESETS = ("--config-dir", "-cd")


def without_own_presets(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """The folder of the user's own presets, None if none is named, and the other arguments.

    Raises:
        ConfigError: there is no such folder, or a preset has the name of one that comes with
            tangram-rl, which hydra would take silently.
    """
    rest = [text for argument in arguments for text in _split_option(argument)]
    at = [number for number, text in enumerate(rest) if text in OWN_PRESETS]
    if not at:
        return None, rest
    if len(at) > 1 or at[0] + 1 == len(rest):
        raise ConfigError(f"{OWN_PRESETS[0]} takes one folder, as in {OWN_PRESETS[0]} my_presets")
    folder = Path(rest[at[0] + 1]).expanduser().absolute()
    if not folder.is_dir():
        raise ConfigError(f"{OWN_PRESETS[0]}: there is no folder {folder}")
    for group in GROUPS:
        taken = {path.stem for path in (folder / group).glob("*.yaml")} & set(choices(group))
        if taken:
            raise ConfigError(
                f"{folder}/{group}/{min(taken)}.yaml has the name of a preset that comes with "
                "tangram-rl: rename it"
            )
    return str(folder), rest[: at[0]] + rest[at[0] + 2 :]


def check_presets(folder: str | None) -> None:
    """Raise ConfigError for a broken or empty preset in the user's folder."""
    if folder is None:
        return
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from tangram_core.store.stored import check_extent

    if Path(folder, "hydra").exists():
        raise ConfigError(f"{OWN_PRESETS[0]}: {folder}/hydra sets hydra's own settings: remove it")
    for path in (path for group in GROUPS for path in Path(folder, group).rglob("*.yaml")):
        try:
            check_extent(path.read_text(encoding="utf-8"), f"preset {path}")
            content = OmegaConf.to_container(OmegaConf.load(path))
        except (
            OSError,
            ValueError,
            RecursionError,
            yaml.YAMLError,
            OmegaConfBaseException,
        ) as error:
            why = " ".join(str(error).split()) or type(error).__name__
            raise ConfigError(f"preset {path} cannot be read ({why}): correct it") from None
        if not (content and isinstance(content, dict)):
            raise ConfigError(f"preset {path} sets nothing: write settings as in name: value")
        # Hydra's settings may name functions, which hydra calls.
        if "hydra" in str(content) or "@package" in path.read_text(encoding="utf-8"):
            raise ConfigError(
                f"preset {path} sets more than its group: leave hydra and @package out"
            )


def options_first(arguments: Sequence[str], config_name: str) -> list[str]:
    """The arguments in the order that hydra's parser needs: options first.

    Raises:
        ConfigError: an option or an override that hydra would refuse or misread.
    """
    options: list[str] = []
    overrides: list[str] = []
    for argument in arguments:
        if options[-1:] == ["--cfg"]:
            if argument not in CFG_KINDS:
                raise ConfigError(f"--cfg takes {', '.join(CFG_KINDS)}, got '{argument}'")
            options.append(argument)
        elif argument in FLAGS:
            options.append(argument)
        elif argument.startswith("-"):
            name = argument.lstrip("-")
            raise ConfigError(
                f"unknown option '{argument}': settings have no dashes, as in "
                f"{name if '=' in name else name + '=...'}; --help lists them"
            )
        else:
            overrides.append(argument)
    if options[-1:] == ["--cfg"]:
        options.append("job")
    if "--cfg" in options and any(one.startswith("from_config=") for one in overrides):
        raise ConfigError(
            "--cfg shows presets and arguments only: leave from_config out, or read its file"
        )
    for override in overrides:
        _check_override(override, COMMANDS[config_name].over)
    if len(set(FLAGS) & set(options)) > 1:
        raise ConfigError("--cfg and --multirun do not go together: leave one out")
    return [*options, *overrides]


def _check_override(override: str, over: Sequence[str]) -> None:
    """Refuse what hydra would misread.

    Hydra merges a list of presets, so that [square,square] would be one square. A removed setting
    would have its default.
    """
    name, _, value = override.lstrip("+~").partition("=")
    if not name:
        raise ConfigError(unreadable(override))
    if override.startswith("~"):
        raise ConfigError(f"'{override}': a setting cannot be removed, write {name}=value instead")
    if name in over:
        raise ConfigError(
            f"{override} chooses a preset, but a trained run has its own {name}: name another run, "
            f"as in run_dir=pretrained/hand, or set single values, see --help {name}"
        )
    if name in GROUPS and value.startswith("["):
        remedy = f"; for several tokens write tokens.shapes={value}" if name == "tokens" else ""
        raise ConfigError(f"{name} takes one preset, got {value}{remedy}")


def explained(error: Exception, config_name: str, kinds: Kinds) -> str:
    """The error text for a wrong command line, with a remedy."""
    from hydra.errors import MissingConfigException, OverrideParseException

    if isinstance(error, MissingConfigException):
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        known = error.options or choices(group)
        return f"unknown {group} '{name}': choose from {', '.join(known)}"
    if isinstance(error, OverrideParseException):
        return unreadable(error.override)
    if isinstance(error, RecursionError):
        return "the arguments are nested too deeply: write fewer brackets"
    if str(error).startswith("Config group override must be"):
        return "a config group takes the name of a preset, not a number: --help lists them"
    if "Ambiguous value" in str(error):
        return f"{first_line(error)}: write [1,2] for a list, '1,2' for a text, --multirun for runs"
    unknown = re.search(r"Could not override '([^']+)'|'([^']+)' does not exist", str(error))
    if unknown:
        name = unknown.group(1) or unknown.group(2)
        return _unknown_setting(name, setting_names(config_name, kinds))
    return first_line(error)


def unreadable(override: object) -> str:
    """The error text for an argument that is not name=value."""
    return f"cannot read '{override}': write name=value, and quote texts with '...'"


def first_line(error: Exception) -> str:
    """The first line of an error text."""
    return str(error).strip().partition("\n")[0]


def _unknown_setting(name: str, known: Sequence[str]) -> str:
    same_ending = [key for key in known if key.rpartition(".")[2] == name]
    close = same_ending or difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean '{close[0]}'?" if close else "--help and --cfg job list them"
    hint = "a trained run keeps its own" if name in GROUPS else hint
    return f"unknown setting '{name}' ({hint})"


def _split_option(argument: str) -> list[str]:
    name, sign, value = argument.partition("=")
    return [name, value] if sign and name in OWN_PRESETS else [argument]
