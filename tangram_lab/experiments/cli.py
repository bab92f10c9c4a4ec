"""The command tangram-experiment.

Everything heavy is imported after the config was composed, so --help and wrong input are instant.
"""

from pathlib import Path

from conf.cli import composed, entry, own_presets
from conf.commands import Plain


def experiment() -> int:
    """tangram-experiment: runs the trainings and tests of experiments."""
    return entry("experiments", _experiment)


def _experiment(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping
    from tangram_lab.experiments.plan import StudyConfig
    from tangram_sim.errors import ConfigError

    run_dir = settings.get("run_dir")
    if isinstance(run_dir, str) and run_dir.strip():
        settings["run_dir"] = str(Path(run_dir).expanduser().absolute())
    if not isinstance(settings.get("experiments"), dict):
        raise ConfigError("experiments are chosen by their presets: experiment=[fig4,table2]")
    config = from_mapping(StudyConfig, settings)
    resolved = {name: _resolved(name, config.command(name)) for name in config.wanted()}
    tests = dict.fromkeys(test for name in resolved for test in config.tests_of(name))
    asked = {name: _asked(name, config.test_command(name)) for name in tests}

    from tangram_lab.experiments.runner import run_study

    return run_study(config, resolved, asked, own_presets())


def _resolved(name: str, overrides: list[str]) -> Plain:
    """The whole config of a training, so that a wrong one is told before any of them starts."""
    from tangram_agent.setup import make_setup
    from tangram_sim.errors import ConfigError

    try:
        settings = composed("train", ["run_dir=x", *overrides])
        make_setup(settings)
    except ConfigError as error:
        raise ConfigError(f"training {name}: {error}") from None
    return settings


def _asked(name: str, overrides: list[str]) -> Plain:
    """What a test asks of tangram-eval, so that a wrong one is told before any training starts."""
    from tangram_agent.setup import from_mapping
    from tangram_sim.errors import ConfigError
    from worker.cli import with_absolute_paths, with_changes
    from worker.config import EvalConfig

    try:
        settings = with_changes(with_absolute_paths(composed("eval", ["run_dir=x", *overrides])))
        from_mapping(EvalConfig, settings)
    except ConfigError as error:
        raise ConfigError(f"test {name}: {error}") from None
    given = {text.partition("=")[0] for text in overrides}
    return {name: settings[name] for name in given & settings.keys()} | dict(settings["changes"])
