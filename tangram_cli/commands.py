"""Entry points of all commands; they protect the imports of `conf`, `master` and `worker`.

Files of a user may have these names, too. A `master.py` in the current folder or on PYTHONPATH
would be imported in place of ours. So every command first makes Python look for these three
packages beside this one.
"""

import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

HOME = Path(__file__).resolve().parents[1]
INTERRUPT_STATUS = 130
COMMON_NAMES = frozenset({"conf", "master", "worker"})


class OwnPackages:
    """Import finder: looks for COMMON_NAMES beside this package, before sys.path."""

    @staticmethod
    def find_spec(
        fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The spec of a package in COMMON_NAMES, else None; see `importlib.abc.MetaPathFinder`."""
        if path is not None or fullname not in COMMON_NAMES:
            return None
        return PathFinder.find_spec(fullname, [str(HOME)], target)


def own_packages_first() -> None:
    """Put `OwnPackages` first among the import finders of this process."""
    if OwnPackages not in sys.meta_path:
        sys.meta_path.insert(0, OwnPackages)


def run(module: str, function: str) -> int:
    """Run a function of a module as a command and return its exit status; 130 after Ctrl-C."""
    own_packages_first()
    # Must be set before numpy is imported. The matrices here are small: several threads would wait
    # for each other longer than they compute, above all on a busy machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        # Imported here, because our packages must come first on the import path before that.
        command: Callable[[], int] = getattr(import_module(module), function)
        return command()
    except KeyboardInterrupt:
        return INTERRUPT_STATUS


master = partial(run, "master.cli", "master")
train = partial(run, "master.cli", "train")
keys = partial(run, "master.cli", "keys")
worker = partial(run, "worker.cli", "worker")
status = partial(run, "worker.cli", "status")
evaluate = partial(run, "tangram_game.cli", "evaluate")
play = partial(run, "tangram_game.cli", "play")
export = partial(run, "tangram_game.cli", "export")
studio = partial(run, "tangram_studio.cli", "studio")
experiment = partial(run, "tangram_lab.experiments.cli", "experiment")
report = partial(run, "tangram_lab.experiments.cli", "report")
bench = partial(run, "tangram_lab.benchmarks.cli", "main")

COMMANDS: dict[str, Callable[[], int]] = {
    "master": master,
    "train": train,
    "keys": keys,
    "worker": worker,
    "status": status,
    "eval": evaluate,
    "play": play,
    "export": export,
    "studio": studio,
    "experiment": experiment,
    "report": report,
    "bench": bench,
}
