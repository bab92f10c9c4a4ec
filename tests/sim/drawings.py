"""Files of puzzles, as people might draw them."""

import json
from copy import deepcopy
from typing import Any

from tangram_sim.puzzles import PACKAGED

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
