"""Settings of tangram-eval, tangram-play and tangram-export."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tangram_agent.pretrained import PREFIX, agent_names
from tangram_core.errors import ConfigError
from tangram_core.settings import Settings, check_folder, refuse_ignored, setting, told
from tangram_sim.puzzles.figures import SPLITS

Changes = dict[str, dict[str, Any]]  # section -> setting -> value that overrides the run's
OF_TARGETS = ("targets", "mirrored")  # settings of sim that concern random targets only
MAX_EPISODES = 1_000_000
MAX_SHOWN = 100
MAX_TURNS = 360
GAME = "tangram7"  # the agent that plays puzzles by default
ALL = ("all",)
PICTURES = (".gif", ".mp4", ".png")
DATA = (".json", ".svg")
WRITTEN = (*PICTURES, *DATA)
MAX_SEED = 2**63 - 1
PUZZLE_FILES = (".json", ".svg")
PUZZLE_HELP = (
    "puzzles instead of random targets: names, as cat or [cat,dog]; or train, test or paper, a "
    "split of the library; or your own JSON file; [mine.json,cat] takes one puzzle of a file"
)
TURNS_HELP = "number of angles of each puzzle, evenly spread; 1: as drawn"


def game_run() -> str:
    """The run that plays puzzles by default."""
    return f"{PREFIX}/{GAME}"


def _check_run(run_dir: str | None, puzzles: bool) -> None:
    """Refuse a missing run_dir if there is no default run."""
    if run_dir is not None:
        check_folder("run_dir", run_dir)
    elif not (puzzles and GAME in agent_names()):
        raise ConfigError("say which run: run_dir=runs/...")


def _refuse(changes: Changes, names: Iterable[str], because: str, remedy: str) -> None:
    """Refuse settings of sim that would change nothing here."""
    for name in names:
        if name in changes.get("sim", {}):
            refuse_ignored(f"sim.{name}={told(changes['sim'][name])}", because, remedy)


def _check_out(value: str) -> None:
    if not Path(value).name:
        raise ConfigError(f"out must name a file, got '{value}': set out=scores.json")


def _check_kept(out: str, name: str, source: str | None) -> None:
    """Refuse an output file that is the input file."""
    with suppress(OSError):  # one of both is no file
        if source is not None and Path(out).samefile(source):
            raise ConfigError(f"out={out} would overwrite {name}={source}: name another file")


@dataclass(frozen=True)
class EvalConfig(Settings):
    """Settings of tangram-eval, which scores a run on fixed tests or puzzles.

    Attributes:
        changes: settings of task, sim, reward and agent that override those of the run.
    """

    run_dir: str | None = setting(
        None, "folder of the run, or pretrained/NAME; with puzzle=, default pretrained/tangram7"
    )
    episodes: int = setting(
        100,
        "number of test episodes, the same ones for every run",
        low=1,
        high=MAX_EPISODES,
        only={"puzzle": None},
    )
    seed: int = setting(
        0, "seed of the test episodes, or of the starts of puzzles", low=0, high=MAX_SEED
    )
    rivals: tuple[str, ...] = setting(
        ALL, "rivals that play the same episodes: all of the task, some by name, or [] for none"
    )
    out: str | None = setting(None, "JSON file for the scores, which are also printed")
    puzzle: tuple[str, ...] | None = setting(None, PUZZLE_HELP)
    turns: int = setting(1, TURNS_HELP, low=1, high=MAX_TURNS, unless={"puzzle": None})
    changes: Changes = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_run(self.run_dir, self.puzzle is not None)
        super().__post_init__()
        if self.out is not None:
            _check_out(self.out)
            source, _ = source_and_names(self.puzzle) if self.puzzle else (None, None)
            _check_kept(self.out, "puzzle", source)
        if self.puzzle is not None:
            _refuse(self.changes, OF_TARGETS, "puzzle", "leave puzzle out")

    @property
    def run(self) -> str:
        """The run to score."""
        return self.run_dir or game_run()


def check_puzzle(value: object) -> tuple[str, ...] | None:
    """Names of puzzles as a tuple, perhaps with their file first; None if there are none.

    Raises:
        ConfigError: the value has another form; the text says how to write it.
    """
    if value is None:
        return None
    names = list(value) if isinstance(value, list | tuple) else [value]
    # A puzzle may be called 8.
    if not names or not all(isinstance(one, str | int | float) and str(one) for one in names):
        raise ConfigError(
            f"puzzle must name puzzles, got {value!r}: set puzzle=cat, puzzle=[cat,dog] or "
            "puzzle=mine.json"
        )
    later = [str(one) for one in names[1:] if is_puzzle_source(str(one))]
    if later:
        raise ConfigError(f"puzzle takes one file or split, first in its list, got {later[0]}, too")
    return tuple(str(name) for name in names)


def is_puzzle_source(name: str) -> bool:
    """Whether a name is that of a file or of a split of the library, not of a puzzle."""
    return name in SPLITS or "/" in name or Path(name).suffix.lower() in PUZZLE_FILES


def source_and_names(puzzle: tuple[str, ...]) -> tuple[str | None, tuple[str, ...] | None]:
    """File or split of puzzles (None: the whole library), and their names (None: all)."""
    if not is_puzzle_source(puzzle[0]):
        return None, puzzle
    return puzzle[0], puzzle[1:] or None


@dataclass(frozen=True)
class PlayConfig(Settings):
    """Settings of tangram-play, which draws the episodes of a run.

    Attributes:
        changes: settings of task, sim, reward and agent that override those of the run.
    """

    run_dir: str | None = setting(
        None, "folder of the run, or an agent that comes with tangram-rl: pretrained/square"
    )
    out: str = setting(
        "runs/play.gif",
        "file to write: .gif or .mp4, an animation; .png, one picture; .json or .svg, positions of "
        "the tokens in a target; .json, also way points of a finger",
    )
    episodes: int = setting(
        12,
        "episodes shown side by side",
        low=1,
        high=MAX_SHOWN,
        only={"puzzle": None, "target": None, "silhouette": None},
    )
    seed: int = setting(
        0, "seed of the episodes, or of the starts of puzzles", low=0, high=MAX_SEED
    )
    puzzle: tuple[str, ...] | None = setting(None, PUZZLE_HELP)
    target: str | None = setting(
        None,
        "target instead of random ones: name of a puzzle, or a file: a puzzle, a drawing, a "
        "black figure, or a photograph of all tokens, three touching at most; the kind is printed",
        only={"puzzle": None},
    )
    silhouette: str | None = setting(
        None,
        "as target, but always a figure with hidden pieces, which a search fills with tokens",
        only={"puzzle": None, "target": None},
    )
    turns: int = setting(1, TURNS_HELP, low=1, high=MAX_TURNS, unless={"puzzle": None})
    changes: Changes = field(default_factory=dict)

    def __post_init__(self) -> None:
        figures = (self.puzzle, self.target, self.silhouette)
        _check_run(self.run_dir, figures != (None, None, None))
        if Path(self.out).suffix not in WRITTEN:
            raise ConfigError(
                f"out must end with {', '.join(WRITTEN)}, got '{self.out}': .gif and .mp4 move, "
                ".png shows the ends, .json and .svg tell where tokens lie"
            )
        if Path(self.out).suffix == ".mp4" and find_spec("av") is None:
            raise ConfigError(
                f"out={self.out} needs PyAV, which is missing: pip install av, or write a .gif"
            )
        super().__post_init__()
        if self.puzzle is not None:
            _refuse(self.changes, (*OF_TARGETS, "starts"), "puzzle", "leave puzzle out")
        if self.target is not None:
            _refuse(self.changes, (*OF_TARGETS, "starts"), "target", "leave target out")
            _check_kept(self.out, "target", self.target)
        if self.silhouette is not None:
            _refuse(self.changes, (*OF_TARGETS, "starts"), "silhouette", "leave silhouette out")
            _check_kept(self.out, "silhouette", self.silhouette)

    @property
    def data(self) -> bool:
        """Whether `out` is a file of data, not a picture."""
        return Path(self.out).suffix in DATA

    @property
    def run(self) -> str:
        """The run to show."""
        return self.run_dir or game_run()


@dataclass(frozen=True)
class ExportConfig(Settings):
    """Settings of tangram-export, which writes an agent as a file that plays without torch.

    Attributes:
        changes: settings that override those of the run.
    """

    run_dir: str = setting("???", "folder of the run, or pretrained/NAME")
    out: str = setting("runs/agent.onnx", "ONNX file to write")
    changes: Changes = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_folder("run_dir", self.run_dir)
        super().__post_init__()
        if Path(self.out).suffix != ".onnx":
            raise ConfigError(f"out must end with .onnx, got '{self.out}': set out=agent.onnx")
        lacking = [name for name in ("onnx", "onnxscript", "onnxruntime") if not find_spec(name)]
        if lacking:
            raise ConfigError(
                f"tangram-export needs {', '.join(lacking)}: pip install {' '.join(lacking)}"
            )
