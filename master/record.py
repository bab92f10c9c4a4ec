"""What a run has been through, over all processes that worked on it, and its clock."""

import secrets
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from tangram_sim.errors import RunError


@dataclass
class Record:
    """Counters that no other part keeps; a checkpoint carries them on.

    Attributes:
        run_id: tells runs apart; stays when a run is resumed.
        loop_s: seconds of the loop, waiting for workers included.
        train_s: seconds of the loop since the first episodes arrived.
        wall_s: seconds of whole processes.
        workers: most players connected at a time.
        scores: of the newest evaluation, by name.
        scored_version: of the weights that they are of; -1 before the first.
    """

    run_id: str = field(default_factory=lambda: secrets.token_hex(8))
    loop_s: float = 0.0
    train_s: float = 0.0
    wall_s: float = 0.0
    workers: int = 0
    scores: dict[str, float] = field(default_factory=dict)
    scored_version: int = -1

    def score(self, scores: Mapping[str, float], version: int) -> None:
        """Note an evaluation."""
        self.scores, self.scored_version = dict(scores), version

    def state(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)

    @staticmethod
    def of(state: Mapping[str, Any]) -> "Record":
        """The record in a checkpoint.

        Raises:
            RunError: it lacks a field.
        """
        lacking = [f.name for f in fields(Record) if f.name not in state]
        if lacking:
            raise RunError(
                f"the checkpoint's record lacks {', '.join(lacking)}: start a new run with "
                "another run_dir"
            )
        return Record(**{f.name: state[f.name] for f in fields(Record)})


class Clock:
    """Adds the time of this process to a record."""

    def __init__(self, record: Record) -> None:
        self._record, self._wall_s = record, record.wall_s
        self._begun_s = self._last_s = time.monotonic()

    def advance(self, training: bool) -> None:
        """Count the time since the last call as the loop's, and as training's if it is that."""
        now_s = time.monotonic()
        self._record.loop_s += now_s - self._last_s
        if training:
            self._record.train_s += now_s - self._last_s
        self._last_s = now_s

    def wall_s(self) -> float:
        """Seconds of all processes of the run."""
        return self._wall_s + time.monotonic() - self._begun_s
