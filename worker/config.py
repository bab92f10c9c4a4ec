"""Settings of a worker process and of the tools that show what a run has learned."""

from dataclasses import dataclass, field
from pathlib import Path

from tangram_agent.config import ServiceConfig
from tangram_agent.decoding import MAX_INDEX
from tangram_agent.wire import ROLES
from tangram_sim.checks import check_choice, check_range
from tangram_sim.errors import ConfigError

MAX_EPISODES = 1_000_000
MAX_ACTIONS = 100
MAX_SHOWN = 100
PICTURES = (".gif", ".png")
MAX_SEED = 2**63 - 1


def _check_run_dir(value: str) -> None:
    if not value.strip():
        raise ConfigError("run_dir must name the folder of a run, got '': set run_dir=runs/my_run")


def _check_out(value: str) -> None:
    if not Path(value).name:
        raise ConfigError(f"out must name a file, got '{value}': set out=scores.json")


def _check_actions(value: int | None) -> None:
    if value is not None:
        check_range("actions", value, 1, MAX_ACTIONS)


@dataclass(frozen=True)
class WorkerConfig:
    """One process that plays for a master, or that scores what the master has learned.

    Attributes:
        connect: where the master listens, such as tcp://192.168.0.7:5555.
        role: player (explores, sends episodes) or evaluator (noise off, sends scores).
        index: number among the workers of a run; -1 lets the master choose.
        service: sizes and intervals.
    """

    connect: str
    role: str = "player"
    index: int = -1
    service: ServiceConfig = field(default_factory=ServiceConfig)

    def __post_init__(self) -> None:
        if not self.connect.strip():
            raise ConfigError(
                "connect must name the master's endpoint, got '': set connect=tcp://HOST:PORT"
            )
        check_choice("role", self.role, ROLES)
        check_range("index", self.index, -1, MAX_INDEX)


@dataclass(frozen=True)
class EvalConfig:
    """Scores of a finished run on the fixed test set (tangram-eval).

    Attributes:
        run_dir: folder of the run.
        episodes: how many of the fixed test episodes.
        actions: actions per token; None is what the run was trained with (Table II: 1 to 5).
        seed: of the test episodes; 0 is the fixed test set that training is scored on.
        out: JSON file for the scores; None prints them only.
    """

    run_dir: str
    episodes: int = 100
    actions: int | None = None
    seed: int = 0
    out: str | None = None

    def __post_init__(self) -> None:
        _check_run_dir(self.run_dir)
        check_range("episodes", self.episodes, 1, MAX_EPISODES)
        check_range("seed", self.seed, 0, MAX_SEED)
        _check_actions(self.actions)
        if self.out is not None:
            _check_out(self.out)


@dataclass(frozen=True)
class PlayConfig:
    """Pictures of a finished run at play (tangram-play).

    Attributes:
        run_dir: folder of the run.
        out: file to write: .gif moves, .png shows the ends.
        episodes: shown side by side.
        actions: actions per token; None is what the run was trained with.
        seed: decides which episodes are shown.
    """

    run_dir: str
    out: str = "play.gif"
    episodes: int = 12
    actions: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _check_run_dir(self.run_dir)
        if Path(self.out).suffix not in PICTURES:
            raise ConfigError(
                f"out must end with {' or '.join(PICTURES)}, got '{self.out}': .gif moves, .png "
                "shows the ends"
            )
        check_range("episodes", self.episodes, 1, MAX_SHOWN)
        _check_actions(self.actions)
        check_range("seed", self.seed, 0, MAX_SEED)
