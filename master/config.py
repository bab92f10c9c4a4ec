"""Settings of a run: of its master, and of a whole training on one machine."""

import os
import shutil
from dataclasses import dataclass, field

from tangram_core.errors import ConfigError
from tangram_core.run.service import ServiceConfig
from tangram_core.settings import Settings, check_folder, declared, setting
from tangram_core.wire.messages import ROLES

MAX_WORKERS = 1024
COMPILERS = ("g++", "clang++")


@dataclass(frozen=True)
class KeysConfig(Settings):
    """Who else may take part in a run (tangram-keys)."""

    run_dir: str = field(metadata=declared("folder of the run"))
    add: str | None = setting(None, "make a key for somebody of this name", only={"revoke": None})
    revoke: str | None = setting(None, "take the key of this name back")
    role: str = setting("player", "that a new key is for", choices=ROLES, unless={"add": None})
    out: str | None = setting(
        None, "connection file with a new key alone; NAME.json if not given", unless={"add": None}
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_folder("run_dir", self.run_dir)


def check_compiling(service: ServiceConfig) -> None:
    """Raise ConfigError, which says what is missing, where updates cannot be compiled."""
    if not service.compile:
        return
    named = os.environ.get("CXX")
    if not any(shutil.which(name) for name in ([named] if named else COMPILERS)):
        raise ConfigError(
            f"service.compile=true needs a C++ compiler, and {named or ' or '.join(COMPILERS)} is "
            "not found: install g++, or set service.compile=false"
        )


@dataclass(frozen=True)
class MasterConfig(Settings):
    """One run, of a master alone or with its workers on this machine."""

    run_dir: str = field(metadata=declared("folder of the run, made if it is missing"))
    seed: int = setting(0, "of everything random in the run", low=0, high=2**63 - 1)
    max_hours: float = setting(0.0, "the run ends after this time, 0 for no bound", low=0, unit="h")
    max_episodes: int = setting(0, "after this many episodes, 0 for no bound", low=0)
    max_updates: int = setting(2000, "after this many updates, 0 for no bound", low=0)
    resume: str = setting(
        "none",
        "none: a folder that holds a run is refused; auto: go on from its newest valid checkpoint",
        choices=("none", "auto"),
    )
    warm_start: str | None = setting(None, "folder of a run whose networks this run begins with")
    workers: int = setting(
        1,
        "processes that play, one evaluator joins them; tangram-master starts none and, in "
        "lockstep, waits for so many",
        low=1,
        high=MAX_WORKERS,
    )
    service: ServiceConfig = field(default_factory=ServiceConfig)

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ConfigError(
                f"workers must be at least 1, got {self.workers}: without one nothing is played; "
                "tangram-master alone waits for workers from elsewhere"
            )
        super().__post_init__()
        check_folder("run_dir", self.run_dir)
