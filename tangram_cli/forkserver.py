"""What the server of `master.forking` does before it forks: all that every process imports."""

import signal
from importlib import import_module

from tangram_cli.commands import own_packages_first

own_packages_first()
signal.pthread_sigmask(signal.SIG_BLOCK, import_module("master.forking").HELD_BACK)
for needed in ("master.run", "worker.play.player", "worker.score.evaluator", "torch"):
    import_module(needed)
