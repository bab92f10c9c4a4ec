"""curve.jsonl: every evaluation of a run, one JSON object a line, for plots without TensorBoard."""

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tangram_agent.files import write_whole

log = logging.getLogger(__name__)


class Curve:
    """Appends to the file as scores arrive, so that it can be read while the run goes on."""

    def __init__(self, path: Path, updates: int) -> None:
        """Open the file.

        Args:
            path: of the file; made with the first line.
            updates: of the checkpoint that the run goes on from; later lines of an earlier process
                are dropped, since they happen again.
        """
        self._path = path
        kept = [line for line in _lines(path) if line["updates"] <= updates]
        if path.exists():
            write_whole(path, "".join(map(_text, kept)).encode())

    def add(self, scores: Mapping[str, float], updates: int, episodes: int, seconds: float) -> None:
        """Note the scores of weights after so many updates, episodes, seconds of training.

        What the disk does not take is left out, and told.
        """
        line = {"updates": updates, "episodes": episodes, "train_s": round(seconds, 3), **scores}
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(_text(line))
        except OSError as error:
            log.warning("%s cannot be written (%s): a score is missing", self._path, error.strerror)


def _text(line: Mapping[str, Any]) -> str:
    return json.dumps(line) + "\n"


def _lines(path: Path) -> list[dict[str, Any]]:
    """What an earlier process wrote; a line that was cut short is left out."""
    found = []
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if isinstance(line, dict) and isinstance(line.get("updates"), int):
            found.append(line)
    return found
