"""Settings of tangram-worker and of tangram-status."""

from dataclasses import dataclass, field

from tangram_core.errors import ConfigError
from tangram_core.run.service import ServiceConfig
from tangram_core.settings import Settings, declared, setting
from tangram_core.wire.messages import MAX_INDEX, ROLES
from worker.talk.discovery import as_address, find_master


@dataclass(frozen=True)
class _Connected(Settings):
    connect: str = field(
        metadata=declared(
            "the run: its folder or its connection.json; host:port only with service.auth=off"
        )
    )

    def __post_init__(self) -> None:
        if not self.connect.strip():
            raise ConfigError(
                "connect must name a run folder or its connection.json, got '': set connect=RUN_DIR"
            )
        if as_address(self.connect) is not None:
            find_master(self.connect)  # reads no file, only checks that the address is valid
        super().__post_init__()


@dataclass(frozen=True)
class WorkerConfig(_Connected):
    """Settings of one worker process, a player or an evaluator."""

    role: str = setting(
        "player",
        "player: plays to learn from; evaluator: scores the agent on fixed tests",
        choices=ROLES,
    )
    index: int = setting(
        -1, "number of this worker; -1: the master chooses one", low=-1, high=MAX_INDEX
    )
    service: ServiceConfig = field(default_factory=ServiceConfig)


@dataclass(frozen=True)
class StatusConfig(_Connected):
    """Settings of tangram-status."""

    json: bool = setting(False, "print the status as one line of JSON instead of a table")
