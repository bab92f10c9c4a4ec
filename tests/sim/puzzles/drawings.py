"""Files of puzzles, as people might draw them."""

import json
from collections.abc import Sequence
from copy import deepcopy
from itertools import permutations
from typing import Any

import numpy as np

from tangram_core.arrays import Floats
from tangram_sim.puzzles.assembly import Puzzle
from tangram_sim.puzzles.figures import PACKAGED

SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))


def figures() -> dict[str, dict[str, Any]]:
    """Name -> entry of every packaged figure of all seven tans."""
    texts = [(PACKAGED / f"{split}.json").read_text() for split in ("train", "test")]
    return {entry["name"]: entry for text in texts for entry in json.loads(text)["puzzles"]}


FIGURES = figures()


def figure(name: str) -> dict[str, Any]:
    """A copy of the entry of a packaged figure."""
    return deepcopy(FIGURES[name])


def file_of(*entries: Any) -> dict[str, Any]:
    """The content of a file of these puzzles."""
    return {"format": "tangram-puzzles", "version": 1, "puzzles": list(entries)}


def moved(points: Floats, angle: float, shift: Sequence[float]) -> Floats:
    cos, sin = np.cos(angle), np.sin(angle)
    turned: Floats = points @ np.array([[cos, sin], [-sin, cos]]) + shift
    return turned


def same_corners(first: Floats, second: Floats) -> float:
    """The largest distance of corners (V, 2) that are the same in some order."""
    orders = permutations(range(len(first)))
    return min(float(np.linalg.norm(first - second[list(o)], axis=1).max()) for o in orders)


def distance(corners: Floats, true: Puzzle, angle: float) -> float:
    """Of a loaded figure from the true one, turned; pieces of one kind may be swapped."""
    goal = moved(true.corners, angle, (0.0, 0.0))
    goal -= (goal.min(axis=0) + goal.max(axis=0)) / 2.0
    own = [true.layout.corners_of(k) for k in range(7)]
    total = 0.0
    for group in ((0, 1), (2,), (3, 4), (5,), (6,)):
        assert len({true.pieces[k] for k in group}) == 1
        total = max(
            total,
            min(
                max(
                    same_corners(corners[own[k]], goal[own[other]])
                    for k, other in zip(group, order, strict=True)
                )
                for order in permutations(group)
            ),
        )
    return total
