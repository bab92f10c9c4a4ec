"""Settings of a worker process, and of who asks how a run stands."""

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
            "the run: its folder or its connection.json; host:port with service.auth=off only"
        )
    )

    def __post_init__(self) -> None:
        if not self.connect.strip():
            raise ConfigError(
                "connect must name the master's endpoint, got '': set connect=HOST:PORT"
            )
        if as_address(self.connect) is not None:
            find_master(self.connect)  # no file is read: it only has to be one
        super().__post_init__()


@dataclass(frozen=True)
class WorkerConfig(_Connected):
    """One process that plays for a master, or that scores what the master has learned."""

    role: str = setting(
        "player", "player, or evaluator: plays fixed tests, noise off, sends scores", choices=ROLES
    )
    index: int = setting(
        -1, "number of this worker, -1: the master gives one", low=-1, high=MAX_INDEX
    )
    service: ServiceConfig = field(default_factory=ServiceConfig)


@dataclass(frozen=True)
class StatusConfig(_Connected):
    """How a run stands (tangram-status)."""

    json: bool = setting(False, "print one JSON object a line instead of a table")
