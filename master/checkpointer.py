"""The checkpointer: batches are on disk before they are acknowledged, the whole run at times.

A run goes on from its newest checkpoint that is whole, and from what the journal holds since.

A disk that takes nothing more ends no run: nothing is acknowledged until there is room again, so
the workers keep what they played, and wait.
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
# Times what a checkpoint took, so that a slow disk leaves nine tenths to the learner; at most an
# hour, since the process may have been stopped meanwhile.
BETWEEN, MOST_BETWEEN_S = 9.0, 3600.0
RETRY_S = 1.0
KEPT = 2  # newest checkpoints: the one before, if the newest is damaged
WAIT = "until then nothing is acknowledged, and workers keep what they played"
MAKE_ROOM = f"make room there; {WAIT}"
PUT_BACK = f"put it back, or make an empty folder there; {WAIT}"
AT_ONCE = "a new segment is begun and a checkpoint written at once, so that nothing is lost"
JOURNAL = "journal"

log = logging.getLogger(__name__)


class Checkpointer:
    """Journals batches, and writes checkpoints when they are due, of nothing that is not finite.

    Attributes:
        failing: the disk takes nothing more.
        homeless: because the run folder is gone, or another one.
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
        except (JournalError, FolderError, DiskError) as error:
            self._failed(error)
            return False
        self._worked()
        return True

    def tick(self) -> None:
        """Sync the journal and write a checkpoint when it is time; a full disk is told."""
        try:
            self._journal.tick()
            if self._look.due():
                self._keep_safe()
            if self._checkpoint.due():
                begun_s = time.monotonic()
                self.save()
                took_s = time.monotonic() - begun_s
                self._checkpoint.rest(min(BETWEEN * took_s, MOST_BETWEEN_S))
        except (JournalError, FolderError, DiskError) as error:
            self._failed(error)

    def save(self) -> Path:
        """Write a checkpoint, and drop the segments of the journal that nobody needs any more.

        Raises:
            RunError: the weights are not finite, one time too many.
            FolderError: the run folder is gone.
            JournalError, DiskError: the disk does not take it; what was there before is as it was.
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
        """Write a checkpoint at once where what was acknowledged is not on the disk any more."""
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
            except RunError as error:  # who joins later misses it, nobody else
                log.warning("%s", error)

    def _failed(self, error: RunError) -> None:
        self.failing, self.homeless = True, isinstance(error, FolderError)
        if self._tell.due():
            remedies = {JournalError: f": {MAKE_ROOM}", FolderError: f": {PUT_BACK}"}
            log.warning("%s%s", error, remedies.get(type(error), ""))

    def _worked(self) -> None:
        if self.failing:
            self.failing, self._tell = False, Every(MINUTE_S, at_once=True)
            log.info("the journal can be written again: batches are taken in")


@dataclass(frozen=True)
class Restored:
    """What a checkpoint holds besides the trainer's state.

    Attributes:
        record: what the run had been through.
        hub: the hub's table of what was inserted, so that nothing is inserted twice.
        place: in the journal, None where it is not known.
    """

    record: Record
    hub: Mapping[str, Any]
    place: Place | None = None

    @staticmethod
    def of(counters: Mapping[str, Any]) -> "Restored":
        """From the counters of a checkpoint; RunError if its record is not whole."""
        record = Record.of(counters["record"])
        return Restored(record, dict(counters["hub"]), _place(counters))


def save_run(folder: Path, trainer: Trainer, rest: Restored, keep: int) -> Path:
    """Write a checkpoint from which `restore_run` goes on; the newest `keep` stay.

    Raises:
        DiskError: the folder cannot be written; what was there before is as it was.
    """
    arrays, counters = trainer.state()
    counters |= {"record": rest.record.state(), "hub": dict(rest.hub)}
    if rest.place is not None:
        counters[JOURNAL] = asdict(rest.place)
    return save_checkpoint(folder, trainer.updates, arrays, counters, keep)


def _place(counters: Mapping[str, Any]) -> Place | None:
    """A checkpoint's place in the journal; RunError if it is none."""
    found = counters.get(JOURNAL)
    if found is None:
        return None
    try:
        return msgspec.convert({"segment": found} if isinstance(found, int) else found, Place)
    except msgspec.ValidationError as error:
        raise RunError(
            f"its place in the journal cannot be read ({error}): delete it to use the one before"
        ) from None


def first_needed(folder: Path) -> int:
    """The first segment of the journal that one of the checkpoints may be continued with."""
    needed = []
    for path in list_checkpoints(folder):
        try:
            place = _place(load_checkpoint(path, stems=[]).counters)
        except RunError:
            continue  # it cannot be gone on from
        needed.append((place or Place()).segment)
    return min(needed, default=1)


def restore_run(folder: Path, trainer: Trainer) -> Restored | None:
    """Take over the newest checkpoint that is whole; corrupt ones are renamed, with a warning.

    Returns:
        What it holds besides the trainer's state, None where there was never a checkpoint.

    Raises:
        RunError: the checkpoint is of another format, task or network, or none is whole.
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
            f"cannot go on from {found.path}: its content is not that of a run "
            f"({type(error).__name__}: {error}); start a new run with another run_dir"
        ) from error


def warm_start(run_dir: Path, trainer: Trainer) -> None:
    """Give the trainer the networks of another run, with fresh optimisers and an empty replay.

    The other run may have had another task, where its networks are of the same shapes; what an
    agent learned of its world it may learn anew.

    Raises:
        RunError: there is no whole checkpoint, or its networks have other shapes.
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
                "checkpoint %s is corrupt (%s): it is %s now, and the one before is taken",
                path,
                error.why,
                aside.name,
            )
    if was_set_aside(folder):
        raise RunError(
            f"no checkpoint in {folder} is whole: put one from a backup there, or start a new run "
            "with another run_dir"
        )
    return None
