"""Checkpoints of a whole run: what is in one, and going on from the newest that is whole."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from master.journal import check_journal, segments
from master.record import Record
from master.rundir import RunFolder
from master.trainer import LEARNER, Trainer, check_same_task
from tangram_agent.checkpoints import (
    Checkpoint,
    CorruptError,
    list_checkpoints,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
    set_aside,
    was_set_aside,
)
from tangram_agent.runs import CHECKPOINTS, SETUP
from tangram_agent.setup import make_setup
from tangram_sim.errors import RunError

SEGMENT = "journal"


def check_resumable(folder: RunFolder, resolved: Mapping[str, Any]) -> None:
    """Refuse another task, or a warm start from nowhere, before anything is overwritten.

    Raises:
        RunError: the newest checkpoint was made with other tokens, sim, reward or net, or there is
            none, and the journal was, or the run that this one is to begin with has none.
    """
    found = list_checkpoints(folder.checkpoints)
    if not found:
        if segments(folder.journal):  # it was killed before its first checkpoint
            check_journal(folder.journal, make_setup(resolved).task_digest())
        _check_warm_start(resolved.get("warm_start"))
        return
    try:
        counters = load_checkpoint(found[-1], stems=[]).counters
    except CorruptError:
        return  # the one before decides, when the run is restored
    check_same_task(make_setup(resolved), counters.get(SETUP, {}))


def _check_warm_start(run_dir: str | None) -> None:
    if run_dir is not None and not list_checkpoints(Path(run_dir) / CHECKPOINTS):
        raise RunError(
            f"warm_start={run_dir} has no checkpoint: name the folder of a run that was trained"
        )


@dataclass(frozen=True)
class Restored:
    """What a checkpoint holds besides the trainer's state.

    Attributes:
        record: what the run had been through.
        hub: the hub's table of what was inserted, so that nothing is inserted twice.
        segment: of the journal, the first one that the checkpoint does not cover.
    """

    record: Record
    hub: Mapping[str, Any]
    segment: int = 1

    @staticmethod
    def of(counters: Mapping[str, Any]) -> "Restored":
        """From the counters of a checkpoint; RunError if its record is not whole."""
        record = Record.of(counters["record"])
        return Restored(record, dict(counters["hub"]), int(counters.get(SEGMENT, 1)))


def save_run(folder: Path, trainer: Trainer, rest: Restored, keep: int) -> Path:
    """Write a checkpoint from which `restore_run` goes on.

    Args:
        folder: of all checkpoints.
        trainer: networks, replay, counters and generators.
        rest: everything else.
        keep: newest checkpoints that stay.

    Raises:
        DiskError: the folder cannot be written; what was there before is as it was.
    """
    arrays, counters = trainer.state()
    counters |= {"record": rest.record.state(), "hub": dict(rest.hub), SEGMENT: rest.segment}
    return save_checkpoint(folder, trainer.updates, arrays, counters, keep)


def first_needed(folder: Path) -> int:
    """The first segment of the journal that one of the checkpoints may be continued with."""
    needed = []
    for path in list_checkpoints(folder):
        try:
            needed.append(int(load_checkpoint(path, stems=[]).counters.get(SEGMENT, 1)))
        except (RunError, TypeError, ValueError):
            continue  # it cannot be gone on from
    return min(needed, default=1)


def restore_run(folder: Path, trainer: Trainer, warn: Callable[[str], None]) -> Restored | None:
    """Take over the newest checkpoint that is whole; corrupt ones are renamed, with a warning.

    Returns:
        What it holds besides the trainer's state, None where there was never a checkpoint.

    Raises:
        RunError: the checkpoint is of another format, task or network, or none is whole.
    """
    found = _newest_whole(folder, warn)
    if found is None:
        return None
    try:
        trainer.load_state(found.arrays, found.counters)
        return Restored.of(found.counters)
    except RunError as error:
        raise RunError(f"cannot go on from {found.path}: {error}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(
            f"cannot go on from {found.path}: its content is not that of a run "
            f"({type(error).__name__}: {error}); start a new run with another run_dir"
        ) from error


def warm_start(run_dir: Path, trainer: Trainer) -> str:
    """Give the trainer the networks of another run, with fresh optimisers and an empty replay.

    The other run may have had other tokens, where the networks do not depend on them (net=mha).

    Returns:
        A line for the user.

    Raises:
        RunError: there is no whole checkpoint, or its networks have other shapes.
    """
    try:
        content = load_checkpoint(newest_checkpoint(run_dir / CHECKPOINTS), [LEARNER])
        trainer.learner.load_networks(content.arrays[LEARNER])
    except RunError as error:
        raise RunError(f"warm_start={run_dir}: {error}") from None
    return f"begins with the networks of {run_dir} after {content.updates:,} updates"


def _newest_whole(folder: Path, warn: Callable[[str], None]) -> Checkpoint | None:
    for path in reversed(list_checkpoints(folder)):
        try:
            return load_checkpoint(path)
        except CorruptError as error:
            aside = set_aside(path)
            warn(
                f"warning: checkpoint {path} is corrupt ({error.why}): it is {aside.name} now, and "
                "the one before is taken"
            )
    if was_set_aside(folder):
        raise RunError(
            f"no checkpoint in {folder} is whole: put one from a backup there, or start a new run "
            "with another run_dir"
        )
    return None
