"""The commands tangram-train, tangram-master and tangram-keys.

Everything heavy is imported after the config was composed, so --help and wrong input are instant.
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from conf.cli import entry, tell
from conf.commands import Plain

if TYPE_CHECKING:
    from tangram_agent.setup import Setup


def train() -> int:
    """tangram-train: a master, an evaluator and workers on this machine."""
    return entry("train", _train)


def master() -> int:
    """tangram-master: the one process that learns."""
    return entry("master", _master)


def keys() -> int:
    """tangram-keys: who else may take part."""
    return entry("keys", _keys)


def _keys(settings: Plain) -> int:
    from master.config import KeysConfig
    from tangram_agent.setup import from_mapping

    config = from_mapping(KeysConfig, settings)

    from master.hub.giving import change_keys

    print("\n".join(change_keys(config)))
    return 0


def _train(settings: Plain) -> int:
    from master.config import MasterConfig, check_compiling
    from tangram_agent.setup import SECTIONS, from_mapping
    from tangram_sim.world.world import check_shown, check_world

    _make_absolute(settings)
    rest = {name: value for name, value in settings.items() if name not in SECTIONS}
    config = from_mapping(MasterConfig, rest)
    # The children check it again; a wrong task is refused before any of them starts.
    setup = _task(settings)
    check_shown(setup.sim, setup.fills)
    check_compiling(config.service, setup.fills)
    check_world(setup.layout, setup.sim)
    tell(f"starts in {config.run_dir}")

    from master.launch import run_training

    return run_training(config, settings)


def _master(settings: Plain) -> int:
    from master.config import MasterConfig, check_compiling
    from tangram_agent.setup import SECTIONS, from_mapping
    from tangram_core.settings import refuse_ignored
    from tangram_sim.world.world import check_room, check_shown

    _make_absolute(settings)
    rest = {name: value for name, value in settings.items() if name not in SECTIONS}
    config = from_mapping(MasterConfig, rest)
    if config.workers > 1 and config.service.mode == "async":
        given, alone = f"workers={config.workers}", "service.mode=async in tangram-master"
        refuse_ignored(given, alone, "start them with tangram-worker", 1)
    setup = _task(settings)
    check_shown(setup.sim, setup.fills)
    check_compiling(config.service, setup.fills)
    check_room(setup.layout, setup.sim)
    tell(f"starts in {config.run_dir}")

    from master.run import run_master

    return run_master(config, setup, settings)


def _task(settings: Plain) -> "Setup":
    """The task; its reward is written into the settings so that it holds for other processes.

    Raises:
        ConfigError: it cannot be trained.
    """
    from tangram_agent.setup import make_setup
    from tangram_core.errors import ConfigError
    from tangram_sim.rewards import check_reward, pinned

    setup = make_setup(settings)
    if setup.agent.beam > 1:
        raise ConfigError(
            f"agent.beam={setup.agent.beam} is for play, an evaluator would be silent "
            "for minutes: leave it out, and give it to tangram-eval or tangram-play"
        )
    setup = replace(setup, reward=pinned(setup.reward))
    check_reward(setup.reward, setup.layout, setup.sim)
    settings["reward"] = asdict(setup.reward)
    return setup


def _make_absolute(settings: Plain) -> None:
    """Folders as seen from where the command was started; what is no text is left alone."""
    for name in ("run_dir", "warm_start"):
        value = settings.get(name)
        if isinstance(value, str) and value.strip():
            settings[name] = str(Path(value).expanduser().absolute())
