"""Agents that come with the package: `pretrained/<name>` wherever a run folder is expected.

An agent's folder holds `config.yaml` (the sections that make a setup), `weights.safetensors` (the
acting actor alone), and `card.json`. `tangram_lab.experiments.pretrained` makes such
folders; one that lies anywhere else is read in the same way.
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
    """The agents that come with the package."""
    if not PACKAGED.is_dir():
        return []
    return sorted(entry.name for entry in PACKAGED.iterdir() if is_agent(entry))


def is_agent(folder: Traversable) -> bool:
    """Whether a folder is an agent's: it has a card, which no run folder has."""
    return folder.is_dir() and (folder / CARD).is_file()


def is_name(run_dir: str | Path) -> bool:
    """Whether a run_dir reads `pretrained/<name>`."""
    parts = Path(run_dir).parts
    return len(parts) == 2 and parts[0] == PREFIX


def packaged(run_dir: str | Path) -> Traversable:
    """The package's folder of `pretrained/<name>`.

    Raises:
        RunError: no agent of that name; lists those that there are.
    """
    name = Path(run_dir).name
    names = agent_names()
    if name not in names:
        known = ", ".join(f"{PREFIX}/{one}" for one in names) or "none come with this version"
        raise RunError(f"no pretrained agent '{name}': choose from {known}")
    return PACKAGED / name


def read_agent(folder: Traversable, shown: str | Path) -> tuple[str, Weights]:
    """Read an agent's folder, with every byte of its weights checked.

    Args:
        folder: where it lies.
        shown: what errors call it.

    Returns:
        The text of its config.yaml, and the weights of the acting actor; their version is the
        number of updates.

    Raises:
        RunError: a file is missing, changed, or of another format.
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
        raise _damaged(shown, f"{CARD} does not tell the updates")
    if card.get("sha256") != hashlib.sha256(data).hexdigest():
        raise _damaged(shown, f"checksum of {WEIGHTS} differs")


def _damaged(shown: str | Path, why: str) -> RunError:
    return RunError(f"{shown} is damaged ({why}): install tangram-rl again")
