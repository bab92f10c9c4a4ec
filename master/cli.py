"""The commands tangram-train and tangram-master.

Everything heavy is imported after the config was composed, so --help and wrong input are instant.
"""

from pathlib import Path

from conf.cli import entry
from conf.commands import Plain


def train() -> int:
    """tangram-train: a master, an evaluator and workers on this machine."""
    return entry("train", _train)


def master() -> int:
    """tangram-master: the one process that learns."""
    return entry("master", _master)


def _train(settings: Plain) -> int:
    from master.config import MasterConfig
    from tangram_agent.setup import SECTIONS, from_mapping, make_setup
    from tangram_sim.rewards import check_reward
    from tangram_sim.world import check_world

    _make_absolute(settings)
    rest = {name: value for name, value in settings.items() if name not in SECTIONS}
    config = from_mapping(MasterConfig, rest)
    # The children check it again; a wrong task is refused before any of them starts.
    setup = make_setup(settings)
    check_world(setup.layout, setup.sim)
    check_reward(setup.reward, setup.layout, setup.sim)

    from master.launch import run_training

    return run_training(config, settings)


def _master(settings: Plain) -> int:
    from master.config import MasterConfig
    from tangram_agent.setup import SECTIONS, from_mapping, make_setup
    from tangram_sim.rewards import check_reward
    from tangram_sim.settings import refuse_ignored
    from tangram_sim.world import check_room

    _make_absolute(settings)
    rest = {name: value for name, value in settings.items() if name not in SECTIONS}
    config = from_mapping(MasterConfig, rest)
    if config.workers > 1 and config.service.mode == "async":
        given, alone = f"workers={config.workers}", "service.mode=async in tangram-master"
        refuse_ignored(given, alone, "start them with tangram-worker", 1)
    setup = make_setup(settings)
    check_room(setup.layout, setup.sim)
    check_reward(setup.reward, setup.layout, setup.sim)

    from master.run import run_master

    return run_master(config, setup, settings)


def _make_absolute(settings: Plain) -> None:
    """Folders as seen from where the command was started; what is no text is left alone."""
    from tangram_sim.rewards import absolute_name

    reward = settings["reward"]
    if isinstance(reward, dict) and isinstance(reward.get("name"), str):
        reward["name"] = absolute_name(reward["name"])
    for name in ("run_dir", "warm_start"):
        value = settings.get(name)
        if isinstance(value, str) and value.strip():
            settings[name] = str(Path(value).expanduser().absolute())
