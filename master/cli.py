"""The commands tangram-train, tangram-master and tangram-keys.

Slow imports come after the config is composed, so --help and error messages appear at once.
"""

import os
from dataclasses import replace
from typing import TYPE_CHECKING

from conf.cli import entry, tell, with_absolute
from conf.commands import Plain
from tangram_core.errors import OwnCodeError, TangramError
from tangram_core.registry import AGENT, SHA256, TASK
from tangram_core.run.code import code_of, where
from tangram_core.run.process import VARIABLE

if TYPE_CHECKING:
    from master.config import MasterConfig
    from tangram_core.setup import Setup


def train() -> int:
    """tangram-train: a master, an evaluator and workers on this machine."""
    return entry("train", _train)


def master() -> int:
    """tangram-master: the process that learns."""
    return entry("master", _master)


def keys() -> int:
    """tangram-keys: add, revoke or list keys of a run."""
    return entry("keys", _keys)


def _keys(settings: Plain) -> int:
    from master.config import KeysConfig
    from tangram_core.setup import from_mapping

    config = from_mapping(KeysConfig, settings)

    from master.hub.giving import change_keys

    print("\n".join(change_keys(config)))
    return 0


def _train(settings: Plain) -> int:
    settings = with_absolute(settings, "run_dir", "warm_start")
    # The children check the config again; here a wrong task is refused before any of them starts.
    config, _ = _checked(settings, plays=True)
    tell(f"starts in {config.run_dir}")

    from master.launch import run_training

    return run_training(config, settings)


def _master(settings: Plain) -> int:
    from tangram_core.settings import refuse_ignored

    settings = with_absolute(settings, "run_dir", "warm_start")
    config, setup = _checked(settings, plays=False)
    if config.workers > 1 and config.service.mode == "async":
        given, alone = f"workers={config.workers}", "service.mode=async in tangram-master"
        refuse_ignored(given, alone, "start them with tangram-worker", 1)
    tell(f"starts in {config.run_dir}")

    from master.run import run_master

    return run_master(config, setup, settings)


def _checked(settings: Plain, *, plays: bool) -> "tuple[MasterConfig, Setup]":
    """Call `_made`; an error in the user's own code becomes one line."""
    try:
        return _made(settings, plays=plays)
    except TangramError:
        raise
    except (Exception, SystemExit) as error:
        own = ", ".join(f"{name}={value}" for name, value in code_of(settings).items())
        if not own:
            raise
        raise OwnCodeError(f"{own} failed: {where(error)}: mend it") from error


def _made(settings: Plain, *, plays: bool) -> "tuple[MasterConfig, Setup]":
    """Build and check the config and the setup; add a digest of the user's code to the settings.

    Raises:
        ConfigError: training is not possible with these settings.
    """
    from master.config import MasterConfig, check_compiling
    from tangram_core.setup import from_mapping, make_setup
    from tangram_core.wire.arrays import check_batch_size

    setup = make_setup(settings)
    rest = {name: value for name, value in settings.items() if name not in setup.sections}
    config = from_mapping(MasterConfig, rest)
    setup.agent.check_training(compiled=config.service.compile)
    given, setup = setup.sections, replace(setup, task=setup.task.pinned())
    setup.task.check(plays=plays)
    if config.service.mode == "lockstep":
        setup.task.check_exact()
    check_batch_size(setup.spec)
    check_compiling(config.service)
    for name, section in setup.sections.items():
        if section is not None and section != given[name]:  # it has a digest of the code now
            settings[name] = settings[name] | vars(section)
    for role, kind in setup.kinds.items():
        settings[role] = settings[role] | kind
    _hold_own_code(setup)
    return config, setup


def _hold_own_code(setup: "Setup") -> None:
    """Test a user's own task or agent with a short game and a few updates, before anything starts.

    Raises:
        ConformanceError: the task or agent breaks a rule of its interface.
    """
    own = [role for role, kind in setup.kinds.items() if SHA256 in kind]
    if not own or VARIABLE in os.environ:  # the launcher did it
        return
    from tangram_core.conformance import check_agent, check_task

    tell(f"plays and learns a little with {' and '.join(own)} of your own")
    if TASK in own:
        check_task(setup.task)
    if AGENT in own:
        check_agent(setup.agent, setup.task)
