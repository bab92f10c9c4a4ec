"""Puzzles: figures of the seven tans, from files and from the package's library.

A file is JSON (see `sketches`), drawn by hand to about a hundredth of a unit. Each piece becomes
the exact tan that fits best. Pieces that overlap a little are pushed apart; gaps stay as drawn.
"""

from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from tangram_core.errors import ConfigError
from tangram_sim.puzzles.assembly import Puzzle, PuzzleRules, build_puzzle
from tangram_sim.puzzles.sketches import Sketch, parse_sketches, read_text

PACKAGED: Traversable = files("tangram_sim") / "puzzles"
SPLITS = ("train", "test", "paper")
_MAX_TOLD = 20  # most faults in one message


def read_puzzles(path: Path, rules: PuzzleRules | None = None) -> tuple[Puzzle, ...]:
    """The puzzles of a JSON file; by default each must have all seven tans.

    Raises:
        ConfigError: the file cannot be used, or has faults; the message lists the faults.
    """
    if path.suffix.lower() == ".svg":
        raise ConfigError(
            f"puzzle={path} is a drawing, which does not name its pieces: fill it with "
            f"tangram-play silhouette={path}, or write the pieces into a JSON file"
        )
    text = read_text(path)
    return parse_puzzles(text, f"puzzle file {path.name}", rules)


def parse_puzzles(text: str, source: str, rules: PuzzleRules | None = None) -> tuple[Puzzle, ...]:
    """The puzzles of a JSON text; `source` is its name in errors. See `read_puzzles`."""
    return _built(parse_sketches(text, source), rules or PuzzleRules())


def _built(sketches: Sequence[Sketch | list[str]], rules: PuzzleRules) -> tuple[Puzzle, ...]:
    puzzles, faults = list[Puzzle](), list[str]()
    for sketch in sketches:
        puzzle, wrong = (
            build_puzzle(sketch, rules) if isinstance(sketch, Sketch) else (None, sketch)
        )
        faults += wrong
        puzzles += [puzzle] if puzzle else []
    if faults:
        told = "; ".join(faults[:_MAX_TOLD])
        more = len(faults) - _MAX_TOLD
        raise ConfigError(told + (f"; and {more} more" if more > 0 else ""))
    return tuple(puzzles)


def load_puzzle(name: str, scale: float = 0.6) -> Puzzle:
    """A puzzle of the package by name; ConfigError for an unknown name."""
    found = {puzzle.name: puzzle for puzzle in library(None, scale)}
    if name not in found:
        raise ConfigError(f"unknown puzzle '{name}': choose from {', '.join(found)}")
    return found[name]


@lru_cache(maxsize=16)
def library(split: str | None = None, scale: float = 0.6) -> tuple[Puzzle, ...]:
    """The package's puzzles of one split, or of all splits.

    Figures of train and test have all seven tans; paper has the figures of the paper. The scale is
    the side of the full square, in arena units.

    Raises:
        ConfigError: the split is unknown.
    """
    if split is None:
        return tuple(puzzle for one in SPLITS for puzzle in library(one, scale))
    if split not in SPLITS:
        raise ConfigError(f"unknown split '{split}': choose from {', '.join(SPLITS)}")
    text = (PACKAGED / f"{split}.json").read_text(encoding="utf-8")
    rules = PuzzleRules(scale, subset=split == "paper")
    return parse_puzzles(text, f"{split}.json", rules)
