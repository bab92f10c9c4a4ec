"""Settings of tangram-report."""

from dataclasses import dataclass

from tangram_sim.errors import ConfigError


@dataclass(frozen=True)
class ReportConfig:
    """A study and where to report on it.

    Attributes:
        runs: folder of the study, with plan.json, or one whose folders are runs.
        out: folder for README.md, data.json and the figures, or the page itself, NAME.md, with the
            others in the folder NAME beside it; files of the same names are replaced.
    """

    runs: str
    out: str

    def __post_init__(self) -> None:
        for name, value in (("runs", self.runs), ("out", self.out)):
            if not value.strip():
                raise ConfigError(f"{name} must name a folder, got '{value}': set {name}=...")
