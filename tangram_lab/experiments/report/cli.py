"""The command tangram-report.

Everything heavy is imported after the config was composed, so --help and wrong input are instant.
"""

from pathlib import Path

from conf.cli import entry
from conf.commands import Plain


def report() -> int:
    """tangram-report: figures and tables of a study."""
    return entry("report", _report)


def _report(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping
    from tangram_lab.experiments.report.config import ReportConfig

    config = from_mapping(ReportConfig, with_absolute_paths(settings))

    from tangram_lab.experiments.report.page import write_report

    for path in write_report(Path(config.runs), Path(config.out)):
        print(f"written: {path}")
    return 0


def with_absolute_paths(settings: Plain) -> Plain:
    """The two folders, seen from where the command was started; what is no text is left alone."""
    result = dict(settings)
    for name in ("runs", "out"):
        value = result.get(name)
        if isinstance(value, str) and value.strip():
            result[name] = str(Path(value).expanduser().absolute())
    return result
