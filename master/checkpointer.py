"""The checkpointer: journals each batch before it is acknowledged, and saves the run at intervals.

A resumed run starts from its newest intact checkpoint and replays the journal written since then.

A full disk does not end the run. Batches are not acknowledged until there is space again, so the
workers keep their episodes and wait.
"""

import logging
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec

from master.hub.hub import Hub
from master.learn.divergence import DivergenceGuard
from master.learn.trainer import LEARNER, Trainer
from master.record.delivery import EpisodesArrived
from master.record.journal import Journal, JournalError, Place
from master.record.rundir import Claim, Clock, FolderError, Record
from tangram_core.errors import RunError
from tangram_core.run.process import Every
from tangram_core.run.service import ServiceConfig
from tangram_core.store.checkpoints import (
    CHECKPOINTS,
    Checkpoint,
    CorruptError,
    DiskError,
    list_checkpoints,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
    set_aside,
    was_set_aside,
)

MINUTE_S = 60.0
# The pause after a checkpoint is nine times its duration: on a slow disk the learner still gets
# nine tenths of the time. At most an hour, because a stopped process makes the duration too long.
BETWEEN, MOST_BETWEEN_S = 9.0, 3600.0
RETRY_S = 1.0
KEPT = 2  # newest checkpoints: the second is used if the newest is damaged
WAIT = "until then nothing is acknowledged, and workers keep what they played"
MAKE_ROOM = f"make room there or mend the disk; {WAIT}"
PUT_BACK = f"put it back, or make an empty folder there; {WAIT}"
AT_ONCE = "a new segment is begun and a checkpoint written at once, so that nothing is lost"
JOURNAL = "journal"

log = logging.getLogger(__name__)


class Checkpointer:
    """Journals batches, and writes a checkpoint when it is due and all values are finite.

    Attributes:
        failing: whether the last write to the disk failed.
        homeless: whether it failed because the run folder is gone or was replaced by another one.
    """

    def __init__(
        self,
        service: ServiceConfig,
        claim: Claim,
        guard: DivergenceGuard,
        hub: Hub,
        journal: Journal,
        clock: Clock,
    ) -> None:
        self._claim, self._guard, self._hub, self._journal = claim, guard, hub, journal
        self._folder, self._clock = claim.run.checkpoints, clock
        self._newest = next(reversed(list_checkpoints(self._folder)), None)
        self._checkpoint = Every(service.checkpoint_minutes * MINUTE_S)
        self.failing = self.homeless = False
        self._look = Every(max(service.journal_sync_seconds, RETRY_S))
        self._saved_s: float | None = None
        self._retry, self._tell = Every(RETRY_S), Every(MINUTE_S, at_once=True)

    @property
    def age_s(self) -> float:
        """Seconds since the last checkpoint of this process, -1 before the first."""
        return -1.0 if self._saved_s is None else time.monotonic() - self._saved_s

    def keep(self, arrival: EpisodesArrived) -> bool:
        """Journal a batch; False while the disk cannot be written to."""
        if self.failing and not self._retry.due():
            return False
        try:
            self._keep_safe()
            self._journal.append(arrival)
            self._claim.check()  # the write may have hung for longer than a lease lasts
        except (OSError, JournalError, FolderError, DiskError) as error:
            self._failed(error)
            return False
        self._worked()
        return True

    def tick(self) -> None:
        """Sync the journal and write a checkpoint if they are due; log a warning on a failure."""
        try:
            self._journal.tick()
            if self._look.due():
                self._keep_safe()
            if self._checkpoint.due():
                begun_s = time.monotonic()
                self.save()
                took_s = time.monotonic() - begun_s
                self._checkpoint.rest(min(BETWEEN * took_s, MOST_BETWEEN_S))
        except (OSError, JournalError, FolderError, DiskError) as error:
            self._failed(error)

    def save(self) -> Path:
        """Write a checkpoint, delete unneeded journal segments; returns the checkpoint's path.

        Raises:
            RunError: the weights were not finite too many times in a row.
            FolderError: the run folder is gone.
            JournalError, DiskError: the disk cannot be written; earlier files are unchanged.
        """
        self._guard.check()
        self._claim.check()
        rest = Restored(self._clock.read(), self._hub.state(), self._journal.rotate())
        self._newest = save_run(self._folder, self._guard.trainer, rest, KEPT)
        self._journal.exposed = False
        self._journal.drop_before(first_needed(self._folder))
        self._saved_s = time.monotonic()
        return self._newest

    def _keep_safe(self) -> None:
        """Write a checkpoint at once if acknowledged data is no longer on the disk."""
        journal, known = self._journal, self._journal.exposed
        gone = "was made anew" if self._claim.check() else ""
        self.homeless = False
        if not journal.in_place():
            gone = gone or "has lost its newest segment of the journal"
            journal.abandon()
        if self._newest is not None and not self._newest.is_dir():
            gone = gone or "has lost its newest checkpoint"
        if gone and not known:
            log.warning("run_dir %s %s: %s", self._claim.run.path, gone, AT_ONCE)
        journal.exposed = journal.exposed or bool(gone)
        if journal.exposed:
            self.save()
            try:
                self._claim.run.write_again()
            except RunError as error:  # only workers that join later need these files
                log.warning("%s", error)

    def _failed(self, error: RunError | OSError) -> None:
        self.failing, self.homeless = True, isinstance(error, FolderError)
        if self._tell.due():
            remedy = f": {PUT_BACK if self.homeless else MAKE_ROOM}"
            # DiskError has its own remedy.
            log.warning("%s%s", error, "" if isinstance(error, DiskError) else remedy)

    def _worked(self) -> None:
        if self.failing:
            self.failing, self._tell = False, Every(MINUTE_S, at_once=True)
            log.info("the journal can be written again: batches are taken in")


@dataclass(frozen=True)
class Restored:
    """Contents of a checkpoint besides the trainer's state.

    Attributes:
        record: counters of the run, such as its time and its newest scores.
        hub: the hub's table of inserted batches, so that no batch is inserted twice.
        place: position in the journal; None if unknown.
    """

    record: Record
    hub: Mapping[str, Any]
    place: Place | None = None

    @staticmethod
    def of(counters: Mapping[str, Any]) -> "Restored":
        """Read the counters of a checkpoint; RunError if the run's record is incomplete."""
        record = Record.of(counters["record"])
        return Restored(record, dict(counters["hub"]), _place(counters))


def save_run(folder: Path, trainer: Trainer, rest: Restored, keep: int) -> Path:
    """Write a checkpoint for `restore_run`, keep only the newest `keep`; returns its path.

    Raises:
        DiskError: the folder cannot be written; earlier checkpoints are unchanged.
    """
    arrays, counters = trainer.state()
    counters |= {"record": rest.record.state(), "hub": dict(rest.hub)}
    if rest.place is not None:
        counters[JOURNAL] = asdict(rest.place)
    return save_checkpoint(folder, trainer.updates, arrays, counters, keep)


def _place(counters: Mapping[str, Any]) -> Place | None:
    """A checkpoint's position in the journal, None if it has none; RunError if it is invalid."""
    found = counters.get(JOURNAL)
    if found is None:
        return None
    try:
        return msgspec.convert(found, Place)
    except msgspec.ValidationError as error:
        raise RunError(
            f"its position in the journal cannot be read ({error}): delete the checkpoint to use "
            "the one before"
        ) from None


def first_needed(folder: Path) -> int:
    """The number of the first journal segment that any checkpoint still needs."""
    needed = []
    for path in list_checkpoints(folder):
        try:
            place = _place(load_checkpoint(path, stems=[]).counters)
        except RunError:
            continue  # a run cannot be resumed from it
        needed.append((place or Place()).segment)
    return min(needed, default=1)


def restore_run(folder: Path, trainer: Trainer) -> Restored | None:
    """Load the newest intact checkpoint into the trainer; rename corrupt ones, with a warning.

    Returns:
        The rest of the checkpoint; None if the run has never had a checkpoint.

    Raises:
        RunError: the checkpoint has another format, task or network, or no checkpoint is intact.
    """
    found = _newest_whole(folder)
    if found is None:
        return None
    try:
        trainer.load_state(found.arrays, found.counters)
        return Restored.of(found.counters)
    except RunError as error:
        raise RunError(f"cannot go on from {found.path}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise RunError(
            f"cannot go on from {found.path}: it is not the checkpoint of a run "
            f"({type(error).__name__}: {error}); start a new run with another run_dir"
        ) from error


def warm_start(run_dir: Path, trainer: Trainer) -> None:
    """Give the trainer the networks of another run, with fresh optimisers and an empty replay.

    The other run may have another task if its networks have the same shapes. An agent may discard
    what it learned about the other world besides the networks.

    Raises:
        RunError: there is no intact checkpoint, or its networks have other shapes.
    """
    try:
        content = load_checkpoint(newest_checkpoint(run_dir / CHECKPOINTS), [LEARNER])
        trainer.learner.begin_with(content.arrays[LEARNER])
    except RunError as error:
        raise RunError(f"warm_start={run_dir}: {error}") from None
    log.info("begins with the networks of %s after %s updates", run_dir, f"{content.updates:,}")


def _newest_whole(folder: Path) -> Checkpoint | None:
    for path in reversed(list_checkpoints(folder)):
        try:
            return load_checkpoint(path)
        except CorruptError as error:
            aside = set_aside(path)
            log.warning(
                "checkpoint %s is corrupt (%s): it was renamed to %s, and the one before is used",
                path,
                error.why,
                aside.name,
            )
    if was_set_aside(folder):
        raise RunError(
            f"no checkpoint in {folder} is intact: put one from a backup there, or start a new run "
            "with another run_dir"
        )
    return None
