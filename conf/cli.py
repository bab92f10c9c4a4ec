"""The entry point of every command: config, overrides, --help, and errors as one line.

Nothing heavy is loaded before the command line is checked, so --help is instant.
"""

import gc
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from conf.arguments import (
    OWN_PRESETS,
    check_presets,
    explained,
    first_line,
    options_first,
    without_own_presets,
)
from conf.commands import COMMANDS, GROUPS, Plain
from conf.help import group_help, help_text, setting_names
from conf.kinds import Kinds, kinds_of, with_usual_agent
from conf.own import with_named_code, without_named_code
from tangram_core.errors import (
    USAGE_STATUS,
    ConfigError,
    TangramError,
    UnavailableError,
    is_passing,
)
from tangram_core.registry import TASK
from tangram_core.run.code import names_modules, unquoted
from tangram_core.settings import CONTROL

if TYPE_CHECKING:
    from omegaconf import DictConfig

# Settings of a command -> name of a run's config and its groups; None: the settings name no run.
Stored = Callable[[Plain], tuple[str, Plain] | None]

MAKE_RUNS = ("train", "master")  # the commands that create their run_dir
MISSING_HINTS = {
    "runs": "say which study: runs=runs/experiments/laptop",
    "run_dir": "say which run: run_dir=runs/...",
    "connect": "say which run: connect=runs/..., or connect= a copy of its connection.json",
}


def entry(config_name: str, task: Callable[[Plain], int], stored: Stored | None = None) -> int:
    """Run a command and return its exit status.

    Args:
        config_name: key of the command in `conf.commands.COMMANDS`.
        task: takes the resolved config as plain containers and returns the exit status.
        stored: returns the groups of a run that the settings name by another setting than
            `from_config`.

    Returns:
        The task's status; 2 after a TangramError or a wrong command line; 75 if the environment
        lacks something. Errors are printed in one line on stderr.
    """
    command = COMMANDS[config_name].name
    arguments = sys.argv[1:]
    if "--version" in arguments:
        print(f"{command} {version('tangram-rl')}")
        return 0
    gc.disable()  # composing frees almost nothing, and collecting took a fifth of its time
    try:
        folder, arguments = without_own_presets(arguments)
        arguments = with_named_code(arguments)
        if config_name in MAKE_RUNS:
            arguments = with_usual_agent(arguments, folder)
        if {"-h", "--help"} & set(arguments):
            kinds = kinds_of(arguments, folder)
            sections = COMMANDS[config_name].sections(kinds)
            asked = [name for name in arguments if name in sections]
            print(
                group_help(config_name, asked[0], folder, kinds)
                if asked
                else help_text(config_name, folder, kinds)
            )
            return 0
        kinds = kinds_of(arguments, folder, _stored_kinds(arguments))
        if TASK not in COMMANDS[config_name].groups:
            arguments = without_named_code(arguments)
        elif stored is not None:  # arguments only allow the modules that the run names
            known = setting_names(config_name, kinds)
            arguments = [a for a in arguments if not names_modules(_key(a)) or _key(a) in known]
        options = [] if folder is None else [OWN_PRESETS[0], folder]
        check_presets(folder)
        sys.argv[1:] = [*options, *options_first(arguments, config_name)]
        return _run(config_name, task, stored, kinds)
    except TangramError as error:
        # The user's input may hold line breaks and control characters of the terminal.
        line = CONTROL.sub(lambda found: ascii(found[0])[1:-1], str(error))
        print(f"{command}: {line}", file=sys.stderr)
        return error.status
    finally:
        gc.enable()


def tell(line: str) -> None:
    """Print what the command waits for, if stderr is a terminal: loading torch takes seconds.

    A child process prints nothing, as it shares the terminal with its parent.
    """
    from tangram_core.run.process import VARIABLE

    if sys.stderr.isatty() and VARIABLE not in os.environ:
        print(line, file=sys.stderr, flush=True)


def with_absolute(settings: Plain, *names: str) -> Plain:
    """Make folders absolute, from the current folder; leave values that are not texts alone."""
    texts = {name: settings.get(name) for name in names}
    found = {n: text for n, text in texts.items() if isinstance(text, str) and text.strip()}
    return settings | {n: str(Path(text).expanduser().absolute()) for n, text in found.items()}


def _run(
    config_name: str, task: Callable[[Plain], int], stored: Stored | None, kinds: Kinds
) -> int:
    """Run a command through hydra, so that its --multirun and --cfg work."""
    import hydra
    from hydra.errors import HydraException
    from omegaconf import DictConfig
    from omegaconf.errors import OmegaConfBaseException

    statuses = [0]
    errors: list[TangramError] = []

    def job(config: DictConfig) -> None:
        gc.enable()
        try:
            statuses.append(task(_plain(config, stored, config_name, kinds)))
        except (TangramError, OSError, MemoryError) as error:
            # Hydra would print two more lines for an exception, but none for an exit.
            errors.append(_as_ours(error))
            raise SystemExit(USAGE_STATUS) from None

    # Without this variable hydra prints errors of the command line over several lines.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    _register(config_name, kinds)
    try:
        if any(_key(text).startswith(("-", "hydra")) for text in sys.argv[1:]):
            hydra.main(version_base="1.3", config_path="pkg://conf", config_name=config_name)(job)()
        else:
            with hydra.initialize_config_module("conf", version_base="1.3"):
                job(_composed_once(config_name, sys.argv[1:]))
    except TangramError:
        raise
    except (
        HydraException,
        OmegaConfBaseException,
        ValueError,
        RecursionError,
        yaml.YAMLError,
    ) as error:
        raise ConfigError(explained(error, config_name, kinds)) from error
    except SystemExit:
        if not errors:
            raise
        raise errors[0] from None
    return max(statuses)


def _composed_once(config_name: str, overrides: list[str]) -> "DictConfig":
    """The config of a command line without options; `hydra.main` would compose it twice."""
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import open_dict

    config = hydra.compose(config_name, overrides, return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        del config["hydra"]
    return config


def _as_ours(error: Exception) -> TangramError:
    """An error of disk, permission or memory as a TangramError with a remedy."""
    kind = UnavailableError if is_passing(error) else TangramError
    if isinstance(error, TangramError):
        return UnavailableError(str(error)) if kind is UnavailableError else error
    if isinstance(error, OSError):
        return kind(
            f"cannot use {error.filename or 'a file'} ({error.strerror or error}): make room or "
            "choose a folder that you may write to"
        )
    return kind(
        f"not enough memory ({error}): lower agent.replay_capacity, agent.batch_size or "
        "service.envs"
    )


def _plain(config: Any, stored: Stored | None, config_name: str, kinds: Kinds) -> Plain:
    """Hydra's config as plain containers, complete and resolved.

    Raises:
        ConfigError: a needed setting is missing, or an interpolation fails.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        missing = sorted(OmegaConf.missing_keys(config))
        settings = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"cannot resolve the config: {first_line(error)}") from None
    if missing:
        raise ConfigError(MISSING_HINTS.get(missing[0], f"set {missing[0]}=..., it has no default"))
    overrides = list(HydraConfig.get().overrides.task)
    plain = _own(_mapping(settings), overrides, kinds)
    in_sweep = HydraConfig.get().mode == RunMode.MULTIRUN and config_name in MAKE_RUNS
    if in_sweep and isinstance(plain.get("run_dir"), str):
        # The jobs of a sweep have the same start time and arguments: give each its own folder.
        plain["run_dir"] = f"{plain['run_dir']}/{HydraConfig.get().job.num}"
    return with_named_reward(with_run_config(plain, overrides, stored), overrides)


def composed(config_name: str, overrides: Sequence[str]) -> Plain:
    """The config of a command for some arguments, also inside a running command.

    Raises:
        ConfigError: an argument that the command would refuse.
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if config_name in MAKE_RUNS:
        overrides = with_usual_agent(overrides)
    kinds = kinds_of(overrides)
    _register(config_name, kinds)
    alone = not GlobalHydra().is_initialized()
    try:
        with hydra.initialize_config_module("conf", version_base="1.3") if alone else nullcontext():
            config = hydra.compose(config_name, list(overrides))
        return _own(_mapping(OmegaConf.to_container(config, resolve=True)), overrides, kinds)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explained(error, config_name, kinds)) from error


def _own(settings: Plain, overrides: Sequence[str], kinds: Kinds) -> Plain:
    """The settings without sections that task and agent do not have, which a preset may set.

    Raises:
        ConfigError: an argument sets a value in such a section.
    """
    other = {*GROUPS} - {*kinds.sections()}
    for name in map(_key, overrides):
        if name.partition(".")[0] in other:
            raise ConfigError(f"{name} is no setting of task={kinds.task}: leave it out")
    return {name: value for name, value in settings.items() if name not in other}


def _register(config_name: str, kinds: Kinds) -> None:
    """Register a command with hydra: its defaults list and the declared defaults."""
    from hydra.core.config_store import ConfigStore

    ConfigStore.instance().store(name=config_name, node=COMMANDS[config_name].node(kinds))


def _mapping(container: object) -> Plain:
    if not isinstance(container, dict):
        raise ConfigError(f"a config must be a mapping, got {type(container).__name__}")
    return {str(name): value for name, value in container.items()}


# A run's config in place of the groups


def with_run_config(
    settings: Plain, overrides: Sequence[str], stored: Stored | None = None
) -> Plain:
    """Replace the groups by those of the run that `from_config` names, and drop `from_config`.

    Single values on the command line override those of the run.

    Args:
        settings: settings of the command.
        overrides: arguments of the command line.
        stored: called for the groups if `from_config` is not set.

    Raises:
        ConfigError: there is no such file, it is no run's config, or an override chooses a preset.
    """
    from omegaconf import OmegaConf

    found = _from_config(settings) or (None if stored is None else stored(settings))
    if found is None:
        return settings
    source, content = found
    content = _sections_of_a_run(content, source)
    chosen = OmegaConf.create(settings)
    rest = {name: value for name, value in settings.items() if not isinstance(value, dict)}
    try:
        result = OmegaConf.create({**rest, **content})
    except RecursionError:
        raise ConfigError(f"{source} is nested too deeply: it must come from a run") from None
    for override in overrides:
        key = _key(override)
        section = key.partition(".")[0]
        if section not in content:
            continue
        if key == section:
            raise ConfigError(
                f"{source} chooses {section} already: leave out {override}, "
                f"or set single values, as in {section}.name=value"
            )
        OmegaConf.update(result, key, OmegaConf.select(chosen, key))
    return _mapping(OmegaConf.to_container(result))


def _sections_of_a_run(content: Plain, source: str) -> Plain:
    """The sections of a run's config for its task, agent and service.

    Raises:
        ConfigError: the content is no run's config.
    """
    from tangram_core.setup import section_names

    try:
        names = (*section_names(content), "service")
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None
    lacking = [name for name in names if name not in content]
    if lacking:
        raise ConfigError(f"{source} lacks {', '.join(lacking)}: it must come from a run")
    return {name: content[name] for name in names}


def _stored_kinds(arguments: Sequence[str]) -> Plain | None:
    """The content of the file in `from_config`; None if there is none or it cannot be read."""
    named = [unquoted(text.partition("=")[2]) for text in arguments if _key(text) == "from_config"]
    if not named:
        return None
    try:
        found = _from_config({"from_config": named[-1]})
    except ConfigError:  # reported later, with the rest of the command line
        return None
    return None if found is None else found[1]


def with_named_reward(settings: Plain, overrides: Sequence[str]) -> Plain:
    """Refuse a reward file that a run's settings or a preset name, but not the command line.

    Raises:
        ConfigError: names the file and the argument to add.
    """
    from tangram_sim.config import with_given_reward

    reward = settings.get("reward")
    if not isinstance(reward, dict):
        return settings
    keys = {_key(override) for override in overrides}
    given = {name: value for name, value in reward.items() if f"reward.{name}" in keys}
    return settings | {"reward": with_given_reward(reward, given)}


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def _from_config(settings: Plain) -> tuple[str, Plain] | None:
    path = settings.pop("from_config", None)
    if path is None:
        return None
    if not isinstance(path, str):
        raise ConfigError(f"from_config must be the path of a run's config.yaml, got {path!r}")
    from tangram_core.store.stored import load_settings

    source = f"from_config={path}"
    try:
        content = load_settings(Path(path).read_text(encoding="utf-8"), source)
    except OSError as error:
        why = error.strerror or error
        raise ConfigError(f"{source}: {why}: name the config.yaml of a run") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{source} is not UTF-8: save it as UTF-8") from None
    return source, content if isinstance(content, dict) else {}
