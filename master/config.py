"""Settings of tangram-train, tangram-master and tangram-keys."""

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
    """Settings of tangram-keys."""

    run_dir: str = field(metadata=declared("folder of the run"))
    add: str | None = setting(
        None, "name of the person or machine that gets a new key", only={"revoke": None}
    )
    revoke: str | None = setting(None, "name of the key to revoke")
    role: str = setting("player", "role of the new key", choices=ROLES, unless={"add": None})
    out: str | None = setting(
        None, "connection file to write with the new key; default NAME.json", unless={"add": None}
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_folder("run_dir", self.run_dir)


def check_compiling(service: ServiceConfig) -> None:
    """Raise ConfigError if updates are to be compiled and there is no compiler."""
    if not service.compile:
        return
    named = os.environ.get("CXX")
    sought, remedy = ((named,), "unset CXX") if named else (COMPILERS, "install g++")
    if not any(shutil.which(name) for name in sought):
        raise ConfigError(
            f"service.compile=true needs a C++ compiler, and {' or '.join(sought)} is not found: "
            f"{remedy}, or set service.compile=false"
        )


@dataclass(frozen=True)
class MasterConfig(Settings):
    """Settings of one run, for tangram-train and tangram-master."""

    run_dir: str = field(metadata=declared("folder of the run, made if it is missing"))
    seed: int = setting(0, "seed of everything random in the run", low=0, high=2**63 - 1)
    max_hours: float = setting(0.0, "end the run after this time, 0 for no bound", low=0, unit="h")
    max_episodes: int = setting(0, "end the run after this many episodes, 0 for no bound", low=0)
    max_updates: int = setting(2000, "end the run after this many updates, 0 for no bound", low=0)
    resume: str = setting(
        "none",
        "none: refuse a folder that holds a run; auto: continue from its newest intact checkpoint",
        choices=("none", "auto"),
    )
    warm_start: str | None = setting(
        None, "folder of a run; this run starts with the networks of that run"
    )
    workers: int = setting(
        1,
        "number of players that tangram-train starts, besides one evaluator; tangram-master starts "
        "none and, in lockstep, waits for this many",
        low=1,
        high=MAX_WORKERS,
    )
    service: ServiceConfig = field(default_factory=ServiceConfig)

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ConfigError(
                f"workers must be at least 1, got {self.workers}: a run needs a player; for "
                "workers on other machines only, start tangram-master"
            )
        super().__post_init__()
        check_folder("run_dir", self.run_dir)
