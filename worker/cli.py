"""The commands tangram-worker and tangram-status.

Everything heavy is imported after the config was composed, so --help and wrong input are instant.
"""

import sys
from functools import partial

from conf.cli import entry
from conf.commands import Plain


def worker() -> int:
    """tangram-worker: plays for a master, or scores what it has learned."""
    return entry("worker", _worker, _of_the_run)


def status() -> int:
    """tangram-status: how a run stands."""
    return entry("status", _status)


def _of_the_run(settings: Plain) -> tuple[str, Plain] | None:
    """What the connection file says of the run; nothing where only an address is given."""
    from tangram_core.run.process import watch_parent
    from worker.talk.discovery import as_address, await_master

    watch_parent()  # already here: a parent may end while the file is waited for
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
    setup.task.check(plays=True)  # before anything is connected

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
