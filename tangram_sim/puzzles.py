"""Puzzles that people know: tokens and the poses that make a figure of them, as JSON.

A file of `puzzles/` holds name, title, arena (its width), scale (see `TokensConfig`) and a list of
tokens: shape, x, y (arena units, origin in the middle) and angle (radians).
"""

import json
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable

import numpy as np

from tangram_sim.arrays import Floats
from tangram_sim.errors import ConfigError
from tangram_sim.geometry import any_overlap
from tangram_sim.layout import Layout, TokensConfig, make_layout

PACKAGED: Traversable = files("tangram_sim") / "puzzles"
_KEYS = {"name", "title", "arena", "scale", "tokens"}
_TOKEN_KEYS = {"shape", "x", "y", "angle"}


@dataclass(frozen=True, eq=False)
class Puzzle:
    """A figure of K tokens.

    Attributes:
        name: of its file.
        title: what it shows.
        arena: width of the square arena that it lies in.
        layout: its tokens.
        poses: (K, 3) x, y (arena units) and angle (radians) of the tokens in the figure.
    """

    name: str
    title: str
    arena: float
    layout: Layout
    poses: Floats

    @property
    def corners(self) -> Floats:
        """(V, 2) of the tokens in the figure."""
        return self.layout.corners(self.poses)


def puzzle_names() -> list[str]:
    """The puzzles that come with the package."""
    names = [entry.name for entry in PACKAGED.iterdir()]
    return sorted(name.removesuffix(".json") for name in names if name.endswith(".json"))


def load_puzzle(name: str) -> Puzzle:
    """A puzzle of the package.

    Raises:
        ConfigError: no such puzzle, or a file that is none.
    """
    if name not in puzzle_names():
        raise ConfigError(f"unknown puzzle '{name}': choose from {', '.join(puzzle_names())}")
    return parse_puzzle((PACKAGED / f"{name}.json").read_text(encoding="utf-8"), name)


def parse_puzzle(text: str, name: str) -> Puzzle:
    """A puzzle from the text of its file.

    Args:
        text: JSON.
        name: what errors call it.

    Raises:
        ConfigError: a key is missing or unknown, a number is none, tokens overlap, or one lies
            outside the arena.
    """
    try:
        content = json.loads(text)
    except ValueError:
        raise ConfigError(f"puzzle '{name}' is not JSON") from None
    if not isinstance(content, dict) or set(content) != _KEYS:
        raise ConfigError(f"puzzle '{name}' must have the keys {', '.join(sorted(_KEYS))}")
    tokens = content["tokens"]
    if not isinstance(tokens, list) or any(
        not isinstance(token, dict) or set(token) != _TOKEN_KEYS for token in tokens
    ):
        raise ConfigError(
            f"puzzle '{name}': tokens must be a list of mappings with the keys "
            f"{', '.join(sorted(_TOKEN_KEYS))}"
        )
    arena, scale = (
        _number(content[key], f"{key} of puzzle '{name}'") for key in ("arena", "scale")
    )
    layout = make_layout(TokensConfig(tuple(token["shape"] for token in tokens), scale))
    poses = np.array(
        [
            [
                _number(token[key], f"{key} of token {k} of puzzle '{name}'")
                for key in ("x", "y", "angle")
            ]
            for k, token in enumerate(tokens)
        ]
    )
    puzzle = Puzzle(str(content["name"]), str(content["title"]), arena, layout, poses)
    _check_figure(puzzle)
    return puzzle


def _number(value: object, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ConfigError(f"{what} must be a finite number, got {value!r}")
    return float(value)


def _check_figure(puzzle: Puzzle) -> None:
    corners = puzzle.corners
    if any_overlap(corners[None], puzzle.layout)[0]:
        raise ConfigError(f"tokens of puzzle '{puzzle.name}' overlap: move them apart")
    reach = float(np.abs(corners).max())
    if reach > puzzle.arena / 2.0:
        raise ConfigError(
            f"puzzle '{puzzle.name}' reaches {reach:.3g} from the middle, further than half of its "
            f"arena of width {puzzle.arena:g}: raise arena or lower scale"
        )
