"""Settings of tangram-report."""

from dataclasses import dataclass, field

from tangram_sim.errors import ConfigError
from tangram_sim.settings import Settings, declared


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
