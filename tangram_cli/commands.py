"""The entry of every command: our packages are found before other modules of their names.

`conf`, `master` and `worker` are names that files of a user may have, too. A `master.py` in the
current folder or on PYTHONPATH would be imported in place of ours, so whoever comes through this
door finds these three beside this package, wherever else they may lie.
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
    """Finds the packages with common names beside this one, before sys.path is asked."""

    @staticmethod
    def find_spec(
        fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """As `importlib.abc.MetaPathFinder`."""
        if path is not None or fullname not in COMMON_NAMES:
            return None
        return PathFinder.find_spec(fullname, [str(HOME)], target)


def own_packages_first() -> None:
    """From here on."""
    if OwnPackages not in sys.meta_path:
        sys.meta_path.insert(0, OwnPackages)


def run(module: str, function: str) -> int:
    """Run a command out of our packages and return its exit status; 130 after Ctrl-C."""
    own_packages_first()
    # numpy multiplies small matrices here: more threads wait for each other, longer than they
    # compute, the more so beside other work. Before numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        # Late: what a command needs may only be imported once our packages come first.
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
