"""What must not be lost goes to disk here: batches before they are acknowledged, and checkpoints.

A disk that takes nothing more ends no run: nothing is acknowledged until there is room again, so
the workers keep what they played, and wait.
"""

import time
from collections.abc import Callable
from pathlib import Path

from master.arrivals import EpisodesArrived
from master.checkpoint import Restored, first_needed, save_run
from master.every import Every
from master.journal import JournalError
from master.parts import Parts
from master.record import Clock
from tangram_agent.checkpoints import DiskError

MINUTE_S = 60.0
RETRY_S = 1.0
MAKE_ROOM = "make room there; until then nothing is acknowledged, and workers keep what they played"


class Keeper:
    """Journals batches, and writes checkpoints when they are due."""

    def __init__(self, parts: Parts, clock: Clock, notice: Callable[[str], None]) -> None:
        self._parts, self._clock, self._notice = parts, clock, notice
        self._checkpoint = Every(parts.config.service.checkpoint_minutes * MINUTE_S)
        self._failing = False
        self._saved_s: float | None = None
        self._retry, self._tell = Every(RETRY_S), Every(MINUTE_S, at_once=True)

    def numbers(self) -> dict[str, float]:
        """How old the last checkpoint of this process is, and whether the disk takes nothing."""
        age_s = -1.0 if self._saved_s is None else time.monotonic() - self._saved_s
        return {"checkpoint_age_s": age_s, "disk_failing": float(self._failing)}

    def keep(self, arrival: EpisodesArrived) -> bool:
        """Journal a batch; False while the disk does not take it."""
        if self._failing and not self._retry.due():
            return False
        try:
            self._parts.journal.append(arrival)
        except JournalError as error:
            self._failed(f"{error}: {MAKE_ROOM}")
            return False
        self._worked()
        return True

    def tick(self) -> None:
        """Sync the journal and write a checkpoint when it is time; a full disk is told."""
        try:
            self._parts.journal.tick()
            if self._checkpoint.due():
                self.save()
        except (JournalError, DiskError) as error:
            self._failed(f"warning: {error}")

    def save(self) -> Path:
        """Write a checkpoint, and drop the segments of the journal that nobody needs any more.

        Raises:
            RunError: the weights are not finite, one time too many.
            DiskError: the disk does not take it; what was there before is as it was.
        """
        parts = self._parts
        parts.guard.check()
        parts.record.wall_s = self._clock.wall_s()
        rest = Restored(parts.record, parts.hub.state(), parts.journal.rotate())
        folder, keep = parts.folder.checkpoints, parts.config.service.keep_checkpoints
        path = save_run(folder, parts.trainer, rest, keep)
        parts.journal.drop_before(first_needed(folder))
        self._saved_s = time.monotonic()
        return path

    def _failed(self, text: str) -> None:
        self._failing = True
        if self._tell.due():
            self._notice(text)

    def _worked(self) -> None:
        if self._failing:
            self._failing, self._tell = False, Every(MINUTE_S, at_once=True)
            self._notice("the journal can be written again: batches are taken in")
