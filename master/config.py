"""Settings of one master process and of a whole training on one machine."""

from dataclasses import dataclass, field

from tangram_agent.config import ServiceConfig
from tangram_sim.errors import ConfigError
from tangram_sim.settings import check_choice, check_range

RESUME = ("none", "auto")
MAX_WORKERS = 1024


@dataclass(frozen=True)
class MasterConfig:
    """One run of the learner.

    Attributes:
        run_dir: folder of the run, made if it is missing.
        seed: of everything random in the run.
        max_hours: hours of training after which it ends, 0 for no bound.
        max_episodes: episodes in the replay after which it ends, 0 for no bound.
        max_updates: updates after which it ends, 0 for no bound.
        resume: none (a folder that holds a run is refused) or auto (go on from its newest valid
            checkpoint, start anew where there is none).
        warm_start: folder of a run whose networks this one begins with, or None.
        service: sockets, rates and intervals.
    """

    run_dir: str
    seed: int = 0
    max_hours: float = 0.0
    max_episodes: int = 0
    max_updates: int = 0
    resume: str = "none"
    warm_start: str | None = None
    service: ServiceConfig = field(default_factory=ServiceConfig)

    def __post_init__(self) -> None:
        if not self.run_dir.strip():
            raise ConfigError("run_dir must name a folder, got '': set run_dir=runs/my_run")
        check_range("seed", self.seed, 0, 2**63 - 1)
        for name in ("max_hours", "max_episodes", "max_updates"):
            check_range(name, getattr(self, name), 0)
        check_choice("resume", self.resume, RESUME)


@dataclass(frozen=True)
class LaunchConfig:
    """A master, its workers and an evaluator on this machine.

    Attributes:
        workers: processes that play.
        master: the learner's settings.
    """

    workers: int
    master: MasterConfig

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ConfigError(
                f"workers must be at least 1, got {self.workers}: without one nothing is played; "
                "tangram-master alone waits for workers from elsewhere"
            )
        check_range("workers", self.workers, 1, MAX_WORKERS)
