"""Start of the fork server of `master.forking`: imports once what every process needs."""

from importlib import import_module

from tangram_cli.commands import own_packages_first

own_packages_first()
for needed in ("torch", "master.run", "worker.play.player", "worker.score.evaluator"):
    import_module(needed)
