"""The commands tangram-experiment and tangram-report.

Everything heavy is imported after the config was composed, so --help and wrong input are instant.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from conf.cli import composed, entry, own_presets
from conf.commands import Plain
from tangram_sim.errors import ConfigError
from tangram_sim.settings import Settings, setting

if TYPE_CHECKING:
    from tangram_lab.experiments.plan import StudyConfig

ROOT = Path(__file__).parents[2]
RESULTS = "docs/results"
GENERATED = ("settings.md",)  # pages that are written from declarations


def experiment() -> int:
    """tangram-experiment: runs the trainings and tests of experiments."""
    return entry("experiments", _experiment)


def _experiment(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping
    from tangram_lab.experiments.plan import StudyConfig

    if not isinstance(settings.get("experiments"), dict):
        raise ConfigError("experiments are chosen by their presets: experiment=[fig4,table2]")
    config = from_mapping(StudyConfig, _with_absolute(settings, "run_dir", "keep"))
    resolved = {name: _resolved(name, config.command(name)) for name in config.wanted()}
    tests = dict.fromkeys(test for name in resolved for test in config.tests_of(name))
    asked = {name: _asked(name, config.test_command(name)) for name in tests}

    from tangram_lab.experiments.runner import run_study

    return run_study(config, resolved, asked, own_presets())


def _resolved(name: str, overrides: list[str]) -> Plain:
    """The whole config of a training, so that a wrong one is told before any of them starts."""
    from tangram_agent.setup import make_setup

    try:
        settings = _composed(overrides)
        make_setup(settings)
    except ConfigError as error:
        raise ConfigError(f"training {name}: {error}") from None
    return settings


def _composed(overrides: Sequence[str]) -> Plain:
    """The whole config that tangram-train makes of its arguments."""
    return composed("train", ["run_dir=x", *overrides])


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

    runs: str | None = setting(
        None,
        "folder that tangram-experiment made, one whose folders are runs, or an earlier report",
        unless={"check": True},
    )
    out: str | None = setting(
        None, "folder for tables.md, data.json and figures", unless={"check": True}
    )
    check: bool = setting(
        False,
        "in a clone: whether README and docs show what the reports in docs/results hold, and "
        "whether this code still trains as the code that made them",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.check:
            _folder("runs", self.runs)
            _folder("out", self.out)


def _folder(name: str, value: str | None) -> Path:
    if value is None or not value.strip():
        raise ConfigError(f"{name} must name a folder, got '{value or ''}': set {name}=...")
    return Path(value)


def report() -> int:
    """tangram-report: figures and tables of a study."""
    if sys.argv[1:2] == ["check"]:
        sys.argv[1] = "check=true"
    return entry("report", _report)


def _report(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping

    config = from_mapping(ReportConfig, _with_absolute(settings, "runs", "out"))
    if config.check:
        return _check()

    from tangram_lab.experiments.report.page import write_report

    runs, out = _folder("runs", config.runs), _folder("out", config.out)
    for path in write_report(runs, out):
        print(f"written: {path}")
    return 0


def _chosen(arguments: list[str]) -> "StudyConfig":
    """The study that tangram-experiment makes of its arguments."""
    from tangram_agent.setup import from_mapping
    from tangram_lab.experiments.plan import StudyConfig

    return from_mapping(StudyConfig, composed("experiments", arguments))


def _check() -> int:
    from tangram_lab.experiments.report.check import check

    if not (ROOT / RESULTS).is_dir():
        raise ConfigError(f"check looks at {RESULTS} of a clone, which {ROOT} lacks: run it in one")
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    shown = (page for page in pages if page.name not in GENERATED)
    wrong = check(ROOT / RESULTS, shown, _composed, _chosen)
    for line in wrong:
        print(line)
    fine = "every score of README and docs is in the data, or names the older commit that it is of"
    print(f"{len(wrong)} wrong" if wrong else fine)
    return 1 if wrong else 0


def _with_absolute(settings: Plain, *names: str) -> Plain:
    """Folders as seen from where the command was started; what is no text is left alone."""
    texts = {name: settings.get(name) for name in names}
    found = {n: text for n, text in texts.items() if isinstance(text, str) and text.strip()}
    return settings | {n: str(Path(text).expanduser().absolute()) for n, text in found.items()}
