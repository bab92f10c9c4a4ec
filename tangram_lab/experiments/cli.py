"""The commands tangram-experiment and tangram-report.

Heavy modules are imported after the settings are read, so --help and wrong input answer at once.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from conf.cli import composed, entry, with_absolute
from conf.commands import Plain
from tangram_core.errors import ConfigError
from tangram_core.settings import Settings, setting

ROOT = Path(__file__).parents[2]
RESULTS = "docs/results"
GENERATED = ("settings.md",)  # pages written by a program, which show no scores


def experiment() -> int:
    """Run tangram-experiment, which does the missing runs of a study; return its exit status."""
    return entry("experiments", _experiment)


def _experiment(settings: Plain) -> int:
    from tangram_core.setup import from_mapping
    from tangram_core.store.files import check_writable
    from tangram_lab.experiments.studies import StudyConfig, jobs_of, read_studies

    config = from_mapping(StudyConfig, with_absolute(settings, "run_dir", "out"))
    rows = Path(config.out or config.run_dir) / f"{config.study}.csv"
    check_writable("out" if config.out else "run_dir", rows)
    jobs = list(jobs_of(config, read_studies()))
    for name, told in dict.fromkeys((job.training, job.told) for job in jobs):
        _check(name, told)

    from master.watch.console import sturdy_console
    from tangram_lab.experiments.runner import run_study

    return run_study(config, jobs, sturdy_console(sys.stdout))


def _check(name: str, told: Sequence[str]) -> None:
    """Raise ConfigError if the settings of a training are invalid, before any training starts."""
    from tangram_core.setup import make_setup

    try:
        make_setup(composed("train", ["run_dir=x", *told]))
    except ConfigError as error:
        raise ConfigError(f"training {name}: {error}") from None


@dataclass(frozen=True)
class ReportConfig(Settings):
    """Settings of tangram-report; existing tables and figures of the same names are replaced."""

    runs: str | None = setting(
        None,
        "folder of CSV files that tangram-experiment wrote, or one whose folders are runs",
        unless={"check": True},
    )
    out: str | None = setting(None, "folder for tables and figures; null is runs")
    check: bool = setting(
        False, "in a clone: check that every score in README and docs is in a CSV file it links"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in (("runs", self.runs), ("out", self.out)):
            if value is not None and not value.strip():
                raise ConfigError(f"{name} must name a folder, got '{value}': set {name}=...")
        if not self.check and self.runs is None:
            raise ConfigError("runs must name a folder: set runs=...")


def report() -> int:
    """Run tangram-report, which writes tables and figures of studies; return its exit status."""
    if sys.argv[1:2] == ["check"]:
        sys.argv[1] = "check=true"
    return entry("report", _report)


def _report(settings: Plain) -> int:
    from tangram_core.setup import from_mapping

    config = from_mapping(ReportConfig, with_absolute(settings, "runs", "out"))
    if config.check:
        return _check_pages()

    from tangram_lab.experiments.report import write_report

    runs = Path(config.runs or "")
    for path in write_report(runs, Path(config.out or runs)):
        print(f"written: {path}")
    return 0


def _check_pages() -> int:
    from tangram_lab.experiments.check import check

    if not (ROOT / RESULTS).is_dir():
        raise ConfigError(f"check needs {RESULTS}, which {ROOT} lacks: run it in a git clone")
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    wrong = check(ROOT / RESULTS, [page for page in pages if page.name not in GENERATED])
    print("\n".join(wrong) or "every score in README and docs is in a file that its section links")
    return 1 if wrong else 0
