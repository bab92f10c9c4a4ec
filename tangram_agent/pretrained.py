"""Pretrained agents in the package: `pretrained/<name>` works in place of a run folder.

The folder of an agent holds `config.yaml` (the sections of its setup), `weights.safetensors` (only
the actor), and `card.json`. `tangram_lab.experiments.pretrained` makes such folders. They are read
in the same way from any other place.
"""

import hashlib
import json
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from tangram_core.agent import Weights
from tangram_core.errors import RunError, WireError
from tangram_core.wire.arrays import decode_tensors

PREFIX = "pretrained"
CONFIG = "config.yaml"
WEIGHTS = "weights.safetensors"
CARD = "card.json"
FORMAT = 2
PACKAGED: Traversable = files("tangram_agent") / PREFIX


def agent_names() -> list[str]:
    """Names of the agents that come with the package, sorted."""
    if not PACKAGED.is_dir():
        return []
    return sorted(entry.name for entry in PACKAGED.iterdir() if is_agent(entry))


def is_agent(folder: Traversable) -> bool:
    """Whether a folder holds a pretrained agent: it has a `card.json`, which run folders lack."""
    return folder.is_dir() and (folder / CARD).is_file()


def is_name(run_dir: str | Path) -> bool:
    """Whether `run_dir` has the form `pretrained/<name>`."""
    parts = Path(run_dir).parts
    return len(parts) == 2 and parts[0] == PREFIX


def packaged(run_dir: str | Path) -> Traversable:
    """The folder inside the package for `pretrained/<name>`.

    Raises:
        RunError: no agent has this name; lists the known names.
    """
    name = Path(run_dir).name
    names = agent_names()
    if name not in names:
        known = ", ".join(f"{PREFIX}/{one}" for one in names) or "none come with this version"
        raise RunError(f"no pretrained agent '{name}': choose from {known}")
    return PACKAGED / name


def read_agent(folder: Traversable, shown: str | Path) -> tuple[str, Weights]:
    """Read the folder of a pretrained agent and check the checksum of its weights.

    Args:
        folder: the folder to read.
        shown: name of the folder in error messages.

    Returns:
        The text of config.yaml, and the weights of the actor. The version of the weights is the
        number of updates.

    Raises:
        RunError: a file is missing or changed, or has another format.
    """
    try:
        config = (folder / CONFIG).read_text(encoding="utf-8")
        card = json.loads((folder / CARD).read_bytes())
        data = (folder / WEIGHTS).read_bytes()
    except OSError as error:
        raise _damaged(shown, str(error.strerror)) from None
    except (ValueError, RecursionError):
        raise _damaged(shown, f"{CONFIG} or {CARD} cannot be read") from None
    _check_card(card, data, shown)
    try:
        tensors = decode_tensors(data, None)
    except WireError as error:
        raise _damaged(shown, str(error)) from None
    return config, Weights(card["updates"], tensors)


def _check_card(card: object, data: bytes, shown: str | Path) -> None:
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise RunError(
            f"{shown}/{CARD} is not of format {FORMAT}, the one that this version reads: use the "
            "version of tangram-rl that wrote it"
        )
    if not isinstance(card.get("updates"), int):
        raise _damaged(shown, f"{CARD} has no number of updates")
    if card.get("sha256") != hashlib.sha256(data).hexdigest():
        raise _damaged(shown, f"checksum of {WEIGHTS} differs")


def _damaged(shown: str | Path, why: str) -> RunError:
    return RunError(f"{shown} is damaged ({why}): install tangram-rl again")
