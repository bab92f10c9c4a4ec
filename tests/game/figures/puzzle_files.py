"""Puzzle files and runs of the game that tests share."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tangram_sim.puzzles.figures import library
from tests.sim.builders import SEVEN

GAME = {"shapes": list(SEVEN), "scale": 0.6}
SIM = {"backend": "kinematic", "starts": "outside", "mirrored": 0.5, "pixels": 16}


def drawn(name: str, pieces: Sequence[int] = range(7), stretch: float = 1.0) -> dict[str, Any]:
    """A figure of the library as a file has it, with some of its pieces."""
    puzzle = next(one for one in library() if one.name == name)
    layout, corners = puzzle.layout, puzzle.corners / puzzle.scale * stretch
    shapes = [
        {
            "shape": layout.shapes[k].name.removesuffix("_mirrored"),
            "corners": np.round(corners[layout.corners_of(k)], 4).tolist(),
        }
        for k in pieces
    ]
    return {"name": f"my_{name}", "pieces": shapes}


def write_puzzles(path: Path, *puzzles: dict[str, Any]) -> Path:
    """A puzzle file."""
    content = {"format": "tangram-puzzles", "version": 1, "puzzles": list(puzzles)}
    path.write_text(json.dumps(content))
    return path
