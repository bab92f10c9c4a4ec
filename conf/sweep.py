"""Sweeps whose jobs run elsewhere: `--multirun hydra/launcher=submitit_slurm`."""

import shutil
from collections.abc import Sequence
from importlib.util import find_spec

from tangram_core.errors import ConfigError, TangramError

LAUNCHER = "hydra/launcher"  # chooses where the jobs of a sweep run
SWEEP = ("--multirun", "-m")


def check_launcher(arguments: Sequence[str]) -> None:
    """Refuse what would otherwise end in a traceback, or in no sweep at all.

    Args:
        arguments: of a command.

    Raises:
        ConfigError: the plugin or SLURM is missing, or nothing is to be swept.
    """
    chosen = [text for text in arguments if text.startswith(f"{LAUNCHER}=")]
    if not chosen:
        return
    if not set(SWEEP) & set(arguments):
        raise ConfigError(f"{chosen[-1]} is for the jobs of a sweep: add --multirun")
    name = chosen[-1].partition("=")[2]
    if name.startswith("submitit") and find_spec("submitit") is None:
        raise ConfigError(
            f"{chosen[-1]} needs the extra slurm: .ci/install .venv slurm in the source tree, "
            "elsewhere pip install 'tangram-rl[slurm]'"
        )
    if name == "submitit_slurm" and shutil.which("srun") is None:
        raise ConfigError(f"{chosen[-1]} needs SLURM, and there is no srun on this machine")


def refuse_lost_job(error: Exception) -> None:
    """Say it in one line where SLURM did not take a job of a sweep, or did not let it end.

    Raises:
        TangramError: that is what the error means; all others are left to the caller.
    """
    if not type(error).__module__.startswith("submitit."):
        return
    said = " ".join(str(error).strip().splitlines()[:2])
    raise TangramError(
        f"a job of the sweep was lost ({said}); the same command with this run_dir and "
        "resume=auto goes on"
    ) from None
