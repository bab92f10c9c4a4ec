"""Whether a run can go on from what is in its folder, known without loading torch."""

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
    """Refuse another task, or a warm start from nowhere, before anything is overwritten.

    Raises:
        RunError: the newest checkpoint was made of another task or networks, or by an agent whose
            networks mean something else, or there is none, and the journal was, or the
            run that this one is to begin with has none.
    """
    found = list_checkpoints(folder.checkpoints)
    if not found:
        if segments(folder.journal):  # it was killed before its first checkpoint
            check_journal(folder.journal, make_setup(resolved).task_digest())
        other = resolved.get("warm_start")
        if other is not None and not list_checkpoints(Path(other) / CHECKPOINTS):
            raise RunError(
                f"warm_start={other} has no checkpoint: name the folder of a run that was trained"
            )
        return
    try:
        counters = load_checkpoint(found[-1], stems=[]).counters
    except CorruptError:
        return  # the one before decides, when the run is restored
    check_same_task(make_setup(resolved), counters.get(SETUP, {}))


def check_same_task(setup: Setup, contents: Mapping[str, Any]) -> None:
    """Raise RunError unless a run of a setup with these contents can go on with this one.

    The agent's rates may change on the way, but not what its networks see, give and learn from.
    """
    odd = [name for name in setup.differences(contents) if name != "agent"]
    odd += setup.meant_otherwise(contents)
    if odd:
        raise RunError(
            f"the run was made with other settings of {', '.join(odd)}: resume it with its own, "
            "from_config=RUN_DIR/config.yaml, or choose another run_dir"
        )
