"""Checks whether a run can be resumed from its folder, without loading torch."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from master.record.journal import segments
from master.record.recovery import check_journal
from master.record.rundir import RunFolder
from tangram_core.errors import RunError
from tangram_core.setup import Setup, make_setup
from tangram_core.store.checkpoints import (
    CHECKPOINTS,
    SETUP,
    CorruptError,
    list_checkpoints,
    load_checkpoint,
)


def check_resumable(folder: RunFolder, resolved: Mapping[str, Any]) -> None:
    """Refuse settings that do not fit the folder, before any file is overwritten.

    Raises:
        RunError: the newest checkpoint has another task or networks; or without a checkpoint, the
            journal has another task, or the run of warm_start has no checkpoint.
    """
    found = list_checkpoints(folder.checkpoints)
    if not found:
        if segments(folder.journal):  # the run was killed before its first checkpoint
            check_journal(folder.journal, make_setup(resolved).task_digest())
        other = resolved.get("warm_start")
        if other is not None and not list_checkpoints(Path(other) / CHECKPOINTS):
            raise RunError(
                f"warm_start={other} has no checkpoint: give the folder of a run with a checkpoint"
            )
        return
    try:
        counters = load_checkpoint(found[-1], stems=[]).counters
    except CorruptError:
        return  # checked when the run is restored, with the checkpoint before
    check_same_task(make_setup(resolved), counters.get(SETUP, {}))


def check_same_task(setup: Setup, contents: Mapping[str, Any]) -> None:
    """Raise RunError unless a run whose setup had these contents can be resumed with this setup.

    Learning rates may change, but not the inputs, outputs and training data of the networks.
    """
    odd = [name for name in setup.differences(contents) if name != "agent"]
    odd += setup.meant_otherwise(contents)
    if odd:
        raise RunError(
            f"the run was made with other settings of {', '.join(odd)}: resume it with its own, "
            "from_config=RUN_DIR/config.yaml, or choose another run_dir"
        )
