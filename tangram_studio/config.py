"""The settings of tangram-studio."""

from dataclasses import dataclass

from tangram_core.settings import Settings, setting


@dataclass(frozen=True)
class StudioConfig(Settings):
    """A page to play on (tangram-studio)."""

    port: int = setting(
        8765, "port of the page, on this machine alone; 0 for any free port", low=0, high=65535
    )
