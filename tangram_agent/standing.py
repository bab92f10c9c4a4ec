"""The messages in which a master tells how its run stands, to whoever is let in and asks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from tangram_agent.frames import MAX_TEXT, Fields, checked_numbers, pack_header
from tangram_agent.payloads import Column, decode_columns
from tangram_agent.wire import Plain
from tangram_sim.arrays import Floats

MAX_ROWS = 4096
WORKER_COLUMNS = (
    "evaluator",  # 1, or 0 for a player
    "index",
    "incarnation",
    "silent_s",  # since its last message
    "behind",  # updates since the weights that its last batch was played with; -1 before one
    "batches",  # since it joined
    "episodes",
    "transitions",
    "waiting",  # batches that are not acknowledged yet
)


@dataclass(frozen=True)
class AskStatus(Plain):
    """Anybody asks how the run stands; no HELLO is needed."""

    kind: ClassVar[str] = "ask_status"


@dataclass(frozen=True, eq=False)
class RunStatus:
    """How a run stands.

    Attributes:
        numbers: name -> value.
        texts: name -> text: what it does or waits for, and who it is.
        workers: (P, 9) float64, a row for each process; see WORKER_COLUMNS.
    """

    kind: ClassVar[str] = "status"
    numbers: Mapping[str, float]
    texts: Mapping[str, str]
    workers: Floats

    def encode(self) -> list[bytes]:
        """The message's frames; rows beyond what a receiver takes are left out."""
        rows = self.workers[:MAX_ROWS]
        header = {
            "numbers": checked_numbers("status", self.numbers),
            "texts": {name: text[: MAX_TEXT // 4] for name, text in self.texts.items()},
            "count": len(rows),
        }
        return [pack_header(self.kind, header), _column(len(rows)).encode(rows)]


def read_status(fields: Fields, frames: Sequence[bytes]) -> RunStatus:
    """The status in a header and its frames.

    Raises:
        WireError: names the field and what is wrong with it.
    """
    numbers, texts = fields.numbers("numbers"), fields.texts("texts", MAX_TEXT)
    count = fields.integer("count", 0, MAX_ROWS)
    fields.end()
    return RunStatus(numbers, texts, decode_columns(frames, [_column(count)])["workers"])


def _column(count: int) -> Column:
    return Column("workers", "<f8", (count, len(WORKER_COLUMNS)), -1.0, 1e18)
