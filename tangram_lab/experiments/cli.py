"""The commands tangram-experiment and tangram-report.

Everything heavy is imported after the config was composed, so --help and wrong input are instant.
"""

from dataclasses import dataclass, field
from pathlib import Path

from conf.cli import composed, entry, own_presets
from conf.commands import Plain
from tangram_sim.errors import ConfigError
from tangram_sim.settings import Settings, declared


def experiment() -> int:
    """tangram-experiment: runs the trainings and tests of experiments."""
    return entry("experiments", _experiment)


def _experiment(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping
    from tangram_lab.experiments.plan import StudyConfig

    if not isinstance(settings.get("experiments"), dict):
        raise ConfigError("experiments are chosen by their presets: experiment=[fig4,table2]")
    config = from_mapping(StudyConfig, _with_absolute(settings, "run_dir"))
    resolved = {name: _resolved(name, config.command(name)) for name in config.wanted()}
    tests = dict.fromkeys(test for name in resolved for test in config.tests_of(name))
    asked = {name: _asked(name, config.test_command(name)) for name in tests}

    from tangram_lab.experiments.runner import run_study

    return run_study(config, resolved, asked, own_presets())


def _resolved(name: str, overrides: list[str]) -> Plain:
    """The whole config of a training, so that a wrong one is told before any of them starts."""
    from tangram_agent.setup import make_setup

    try:
        settings = composed("train", ["run_dir=x", *overrides])
        make_setup(settings)
    except ConfigError as error:
        raise ConfigError(f"training {name}: {error}") from None
    return settings


def _asked(name: str, overrides: list[str]) -> Plain:
    """What a test asks of tangram-eval, so that a wrong one is told before any training starts."""
    from tangram_agent.setup import from_mapping
    from worker.cli import with_absolute_paths, with_changes
    from worker.config import EvalConfig

    try:
        settings = with_changes(with_absolute_paths(composed("eval", ["run_dir=x", *overrides])))
        from_mapping(EvalConfig, settings)
    except ConfigError as error:
        raise ConfigError(f"test {name}: {error}") from None
    given = {text.partition("=")[0] for text in overrides}
    return {name: settings[name] for name in given & settings.keys()} | dict(settings["changes"])


@dataclass(frozen=True)
class ReportConfig(Settings):
    """A study and where to report on it; files of the same names are replaced."""

    runs: str = field(
        metadata=declared("folder that tangram-experiment made, or one whose folders are runs")
    )
    out: str = field(
        metadata=declared(
            "folder for README.md, figures and data.json, or the page itself as in docs/results.md"
        )
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in (("runs", self.runs), ("out", self.out)):
            if not value.strip():
                raise ConfigError(f"{name} must name a folder, got '{value}': set {name}=...")


def report() -> int:
    """tangram-report: figures and tables of a study."""
    return entry("report", _report)


def _report(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping

    config = from_mapping(ReportConfig, _with_absolute(settings, "runs", "out"))

    from tangram_lab.experiments.report.page import write_report

    for path in write_report(Path(config.runs), Path(config.out)):
        print(f"written: {path}")
    return 0


def _with_absolute(settings: Plain, *names: str) -> Plain:
    """Folders as seen from where the command was started; what is no text is left alone."""
    texts = {name: settings.get(name) for name in names}
    found = {n: text for n, text in texts.items() if isinstance(text, str) and text.strip()}
    return settings | {n: str(Path(text).expanduser().absolute()) for n, text in found.items()}
