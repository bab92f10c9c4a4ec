"""The commands tangram-worker and tangram-status.

Heavy modules are imported after the settings are read, so --help and wrong input answer at once.
"""

import sys
from functools import partial

from conf.cli import entry
from conf.commands import Plain


def worker() -> int:
    """Run tangram-worker, a player or an evaluator, and return its exit status."""
    return entry("worker", _worker, _of_the_run)


def status() -> int:
    """Run tangram-status, which prints the state of a run, and return its exit status."""
    return entry("status", _status)


def _of_the_run(settings: Plain) -> tuple[str, Plain] | None:
    """The run's settings from its connection file; None if `connect` is an address."""
    from tangram_core.run.process import watch_parent
    from worker.talk.discovery import as_address, await_master

    watch_parent()  # already here: the parent may end while this process waits for the file
    connect = settings.get("connect")
    if not isinstance(connect, str) or not connect.strip() or as_address(connect) is not None:
        return None
    found = await_master(connect, partial(print, file=sys.stderr, flush=True)).settings
    return None if found is None else (f"connect={connect}", dict(found))


def _worker(settings: Plain) -> int:
    from tangram_core.setup import from_mapping, make_setup
    from worker.config import WorkerConfig

    setup = make_setup(settings)
    rest = {name: value for name, value in settings.items() if name not in setup.sections}
    config = from_mapping(WorkerConfig, rest)
    setup.task.check(plays=True)  # before the connection is opened

    from worker.play.session import keep_part

    if config.role == "evaluator":
        from worker.score.evaluator import run_evaluator

        return keep_part(run_evaluator, config, setup)
    from worker.play.player import run_player

    return keep_part(run_player, config, setup)


def _status(settings: Plain) -> int:
    from tangram_core.setup import from_mapping
    from worker.config import StatusConfig

    config = from_mapping(StatusConfig, settings)

    from worker.status import show_status

    return show_status(config)
