"""Settings of a worker process and of the tools that show what a run has learned."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tangram_agent.config import ORDERS, ServiceConfig
from tangram_agent.messages import MAX_INDEX, ROLES
from tangram_agent.pretrained import PREFIX, agent_names
from tangram_sim.config import MAX_CORNER_NOISE
from tangram_sim.errors import ConfigError
from tangram_sim.settings import check_choice, check_range

CHANGES = ("order", "reapply", "refine_steps", "push_weight")  # of how an agent plays
MAX_EPISODES = 1_000_000
MAX_ACTIONS = 100
MAX_SHOWN = 100
MAX_TURNS = 360
GAME = "tangram7"  # the agent that plays puzzles unless another is named
PICTURES = (".gif", ".png")
MIN_COMPARED, MAX_COMPARED = 2, 4
MAX_SECONDS = 86_400.0
MAX_SEED = 2**63 - 1


def _check_run_dir(value: str) -> None:
    if not value.strip():
        raise ConfigError("run_dir must name the folder of a run, got '': set run_dir=runs/my_run")


def game_run() -> str:
    """The run that plays puzzles unless another is named."""
    return f"{PREFIX}/{GAME}"


def _check_run(run_dir: str | None, puzzles: bool) -> None:
    """Refuse no run where none can be meant."""
    if run_dir is not None:
        _check_run_dir(run_dir)
    elif not (puzzles and GAME in agent_names()):
        raise ConfigError("say which run: run_dir=runs/...")


def _check_connect(value: str) -> None:
    if not value.strip():
        raise ConfigError(
            "connect must name the master's endpoint, got '': set connect=tcp://HOST:PORT"
        )


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
        _check_connect(self.connect)
        check_choice("role", self.role, ROLES)
        check_range("index", self.index, -1, MAX_INDEX)


@dataclass(frozen=True)
class StatusConfig:
    """How a run stands (tangram-status).

    Attributes:
        connect: where its master listens: tcp://host:port, a connection file or a run folder.
        every_seconds: ask again after so long; 0 asks once.
        json: print a JSON object instead of a table.
    """

    connect: str
    every_seconds: float = 0.0
    json: bool = False

    def __post_init__(self) -> None:
        _check_connect(self.connect)
        check_range("every_seconds", self.every_seconds, 0.0, MAX_SECONDS)


@dataclass(frozen=True)
class EvalConfig:
    """Scores of a finished run on the fixed test set, or on puzzles (tangram-eval).

    Attributes:
        run_dir: folder of the run; None with puzzles: the agent of the game.
        episodes: how many of the fixed test episodes; of no account with puzzles.
        actions: actions per token; None is what the run was trained with (Table II: 1 to 5).
        corner_noise: see `SimConfig`; None is what the run was trained with.
        seed: of the test episodes; 0 is the fixed test set that training is scored on.
        out: JSON file for the scores; None prints them only.
        puzzles: a file, or a split of the library, to assemble instead of random targets.
        turns: angles that each puzzle is played at, evenly spread from how it is drawn.
        skip_invalid: leave out puzzles that cannot be played.
        sheet: PNG file for a picture of every puzzle's end.
        order, reapply, refine_steps, push_weight: see `AgentConfig`; None: as the run was trained.
    """

    run_dir: str | None = None
    episodes: int = 100
    actions: int | None = None
    corner_noise: float | None = None
    seed: int = 0
    out: str | None = None
    puzzles: str | None = None
    turns: int = 1
    skip_invalid: bool = False
    sheet: str | None = None
    order: str | None = None
    reapply: int | None = None
    refine_steps: int | None = None
    push_weight: float | None = None

    def __post_init__(self) -> None:
        _check_run(self.run_dir, self.puzzles is not None)
        check_range("episodes", self.episodes, 1, MAX_EPISODES)
        check_range("seed", self.seed, 0, MAX_SEED)
        _check_actions(self.actions)
        if self.corner_noise is not None:
            check_range("corner_noise", self.corner_noise, 0.0, MAX_CORNER_NOISE)
        if self.out is not None:
            _check_out(self.out)
        if self.order is not None:
            check_choice("order", self.order, ORDERS)
        self._check_puzzles()

    @property
    def run(self) -> str:
        """The run to score."""
        return self.run_dir or game_run()

    @property
    def agent_changes(self) -> dict[str, Any]:
        """What is set of the agent's play."""
        named = {name: getattr(self, name) for name in CHANGES}
        return {name: value for name, value in named.items() if value is not None}

    def _check_puzzles(self) -> None:
        check_range("turns", self.turns, 1, MAX_TURNS)
        needs = {"turns": self.turns > 1, "sheet": self.sheet, "skip_invalid": self.skip_invalid}
        for name, given in needs.items():
            if given and self.puzzles is None:
                raise ConfigError(f"{name} is for puzzles: set puzzles=test, or leave {name} out")
        if self.sheet is not None and Path(self.sheet).suffix != ".png":
            raise ConfigError(f"sheet must end with .png, got '{self.sheet}'")


def check_compare(value: object) -> None:
    """Refuse what is no list of a few different run folders; None is none.

    Raises:
        ConfigError: says how to write one.
    """
    if value is None:
        return
    runs = list(value) if isinstance(value, list | tuple) else []
    named = all(isinstance(run, str) and run.strip() for run in runs)
    if not (named and MIN_COMPARED <= len(runs) <= MAX_COMPARED):
        raise ConfigError(
            f"compare must list {MIN_COMPARED} to {MAX_COMPARED} folders of runs, got {value!r}: "
            "set compare=[runs/a,runs/b]"
        )
    if len(set(runs)) < len(runs):
        raise ConfigError(f"compare must list different runs, got {value!r}: name each one once")


def check_puzzle(value: object) -> tuple[str, ...] | None:
    """The names of puzzles: one or a list of some; None is none.

    Raises:
        ConfigError: says how to write them.
    """
    if value is None:
        return None
    names = list(value) if isinstance(value, list | tuple) else [value]
    # A puzzle may be called 8.
    if not names or not all(isinstance(one, str | int | float) and str(one) for one in names):
        raise ConfigError(
            f"puzzle must name puzzles, got {value!r}: set puzzle=cat or puzzle=[cat,dog]"
        )
    return tuple(str(name) for name in names)


@dataclass(frozen=True)
class PlayConfig:
    """Pictures of finished runs at play (tangram-play): of one, or of several on the same starts.

    Attributes:
        run_dir: folder of the run; None to compare, or with tokens or puzzles.
        out: file to write: .gif moves, .png shows the ends.
        episodes: shown side by side; of no account with puzzles.
        actions: actions per token; None is what each run was trained with.
        seed: decides which episodes are shown, and where pieces of puzzles start.
        compare: folders of 2 to 4 runs of the same tokens and arena; None to show one.
        tokens: the agent of these tokens that comes with the package; with `run_dir` both agree.
        puzzle: names of puzzles to assemble instead of random targets; None with `puzzles`: all.
        puzzles: a file, or a split of the library, that they are in; None is all of the library.
        live: play in a window instead of writing a file.
    """

    run_dir: str | None = None
    out: str = "play.gif"
    episodes: int = 12
    actions: int | None = None
    seed: int = 0
    compare: tuple[str, ...] | None = None
    tokens: str | None = None
    puzzle: tuple[str, ...] | None = None
    puzzles: str | None = None
    live: bool = False

    def __post_init__(self) -> None:
        check_compare(self.compare)
        self._check_one_of_both()
        if Path(self.out).suffix not in PICTURES:
            raise ConfigError(
                f"out must end with {' or '.join(PICTURES)}, got '{self.out}': .gif moves, .png "
                "shows the ends"
            )
        check_range("episodes", self.episodes, 1, MAX_SHOWN)
        _check_actions(self.actions)
        check_range("seed", self.seed, 0, MAX_SEED)

    @property
    def plays_puzzles(self) -> bool:
        """Whether puzzles are to be assembled."""
        return self.puzzle is not None or self.puzzles is not None

    @property
    def run_dirs(self) -> tuple[str, ...]:
        """The runs to show, one or several."""
        named = f"{PREFIX}/{self.tokens}" if self.tokens is not None else game_run()
        return self.compare or (self.run_dir or named,)

    def _check_one_of_both(self) -> None:
        if self.compare is not None:
            self._check_compared_alone()
        elif self.run_dir is not None:
            _check_run_dir(self.run_dir)
        elif self.tokens is None and not (self.plays_puzzles and GAME in agent_names()):
            raise ConfigError(
                "say which run: run_dir=runs/..., or which ones: compare=[runs/a,runs/b]"
            )

    def _check_compared_alone(self) -> None:
        names = ("run_dir", "tokens", "puzzle", "puzzles", "live")
        others: dict[str, Any] = {name: getattr(self, name) for name in names}
        for name, value in others.items():
            if value not in (None, False):
                raise ConfigError(
                    f"{name}={value} and compare do not go together: give run_dir=... to show one "
                    "run, or compare=[a,b] to show several on random targets"
                )
