"""Checkpoint folders: written whole or not at all, read with every byte checked.

A checkpoint is a folder named after the number of updates (eight digits, `-1`, `-2`... behind it
when one of that number exists already) with `manifest.json` and one safetensors file for each
group of tensors. It is written under a temporary name beside, synced, and renamed, so that a
folder with a checkpoint's name is complete unless the disk itself lost bytes; those are found by
the checksums in the manifest.
"""

import hashlib
import json
import logging
import os
import re
import shutil
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypedDict

import msgspec
import numpy as np
import numpy.typing as npt
import safetensors.numpy

from tangram_core.errors import RunError, WireError
from tangram_core.run.process import still_alive
from tangram_core.store.files import make_folders, sync_folder
from tangram_core.wire.arrays import load_tensors

FORMAT_VERSION = 4
MANIFEST = "manifest.json"
CHECKPOINTS = "checkpoints"  # the folder of all of them in that of a run
ACTING = "weights"  # the file of acting weights
SETUP = "setup"  # the counter that tells the setup
_NAME = re.compile(r"(\d{8,})(?:-(\d+))?")
_TEMPORARY = ".writing-"
_SET_ASIDE = ".corrupt"
_PART = 1 << 24  # bytes after which it is told that the process lives

log = logging.getLogger(__name__)

Tensors = dict[str, npt.NDArray[Any]]


class _Manifest(TypedDict):
    """What a manifest says besides its format and its checksum."""

    updates: Annotated[int, msgspec.Meta(ge=0)]
    files: dict[str, str]
    counters: dict[str, Any]


class DiskError(RunError):
    """A checkpoint could not be written to the disk."""


class CorruptError(RunError):
    """A checkpoint that is not as it was written; `why` names the file and what is wrong."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"checkpoint {path} is corrupt ({why}): delete it to use the one before")
        self.path, self.why = path, why


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What one checkpoint folder holds.

    Attributes:
        arrays: file stem -> tensor name -> array; only the stems that were asked for.
        counters: everything that is no tensor, as it was passed to `save_checkpoint`.
    """

    path: Path
    updates: int
    arrays: dict[str, Tensors]
    counters: dict[str, Any]


def save_checkpoint(
    folder: Path,
    updates: int,
    arrays: Mapping[str, Mapping[str, npt.NDArray[Any]]],
    counters: Mapping[str, Any],
    keep: int,
) -> Path:
    """Write a checkpoint and drop all but the newest `keep`.

    Args:
        folder: holds all checkpoints of a run; made if it is missing, in a folder that is there.
        arrays: file stem -> tensor name -> array.
        counters: JSON values.

    Raises:
        DiskError: the folder cannot be written; what was there before is as it was.
    """
    aside = folder / f"{_TEMPORARY}{updates:08d}"
    try:
        make_folders(folder, above=False)
        _delete(folder.glob(f"{_TEMPORARY}*"))
        aside.mkdir()
        _write_content(aside, updates, arrays, counters)
        final = _free_name(folder, updates)
        # From here on it counts; a crash before leaves the older ones as they are.
        aside.rename(final)
        sync_folder(folder)
    except OSError as error:
        shutil.rmtree(aside, ignore_errors=True)  # others may need the room
        raise DiskError(
            f"cannot write a checkpoint to {folder} ({error}): make room there or choose another "
            "run_dir"
        ) from None
    _delete(list_checkpoints(folder)[:-keep])
    return final


def _delete(folders: Iterable[Path]) -> None:
    """What nobody needs any more; if it cannot be deleted, that is told and no harm."""
    for folder in folders:
        try:
            shutil.rmtree(folder)
        except OSError as error:
            log.warning("%s cannot be deleted (%s): delete it yourself", folder, error.strerror)


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoint folders, oldest first; none where there is no such folder."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if _NAME.fullmatch(path.name) and path.is_dir()]
    return sorted(found, key=_order)


def newest_checkpoint(folder: Path) -> Path:
    """The newest checkpoint, whether or not its content is whole; RunError if there is none."""
    found = list_checkpoints(folder)
    if not found:
        raise RunError(f"no checkpoint in {folder}: train the run first, or name another run_dir")
    return found[-1]


def load_checkpoint(path: Path, stems: Collection[str] | None = None) -> Checkpoint:
    """Read a checkpoint, or only the named files of it.

    Raises:
        CorruptError: a file is missing or changed; names it.
        RunError: it cannot be read, is of another format, or never had a named file.
    """
    manifest = _read_manifest(path)
    names = manifest["files"] if stems is None else stems
    arrays = {stem: _read_tensors(path, stem, manifest["files"]) for stem in names}
    return Checkpoint(path, manifest["updates"], arrays, manifest["counters"])


def set_aside(path: Path) -> Path:
    """Rename a corrupt checkpoint, so that it no longer counts as one but is not lost."""
    target = path.with_name(path.name + _SET_ASIDE)
    if target.exists():
        shutil.rmtree(target)
    path.rename(target)
    sync_folder(path.parent)
    return target


def was_set_aside(folder: Path) -> bool:
    """Whether a corrupt checkpoint lies here."""
    return any(folder.glob(f"*{_SET_ASIDE}"))


def _order(path: Path) -> tuple[int, int]:
    match = _NAME.fullmatch(path.name)
    if match is None:
        raise RunError(f"{path} is no checkpoint: its name is not a number of updates")
    return int(match[1]), int(match[2] or 0)


def _free_name(folder: Path, updates: int) -> Path:
    """An unused name for this number of updates: a full folder cannot be renamed onto."""
    orders = map(_order, list_checkpoints(folder))
    again = max((number for found, number in orders if found == updates), default=-1) + 1
    return folder / (f"{updates:08d}-{again}" if again else f"{updates:08d}")


def _write_content(
    aside: Path,
    updates: int,
    arrays: Mapping[str, Mapping[str, npt.NDArray[Any]]],
    counters: Mapping[str, Any],
) -> None:
    files = {}
    for stem, tensors in arrays.items():
        # safetensors writes a view's memory as it lies, so the order must be C.
        content = {name: np.asarray(value, order="C") for name, value in tensors.items()}
        data = safetensors.numpy.save(content)
        _write(aside / f"{stem}.safetensors", data)
        files[stem] = hashlib.sha256(data).hexdigest()
    # Through JSON first: keys become texts, and the reader's digest is of what it can read.
    body = json.loads(json.dumps({"updates": updates, "files": files, "counters": counters}))
    manifest = {"format_version": FORMAT_VERSION, "sha256": _digest(body), **body}
    _write(aside / MANIFEST, json.dumps(manifest, indent=1).encode())
    sync_folder(aside)


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        for start in range(0, len(data), _PART):
            file.write(memoryview(data)[start : start + _PART])
            file.flush()
            os.fsync(file.fileno())
            still_alive()


def _content(path: Path) -> bytes:
    parts = []
    with path.open("rb") as file:
        while part := file.read(_PART):
            parts.append(part)
            still_alive()
    return b"".join(parts)


def _digest(body: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def _read_manifest(path: Path) -> _Manifest:
    try:
        content = json.loads((path / MANIFEST).read_bytes())
        manifest = content if isinstance(content, dict) else {}
        body = {name: manifest.get(name) for name in _Manifest.__annotations__}
        digest = _digest(body)
    except FileNotFoundError:
        raise CorruptError(path, f"{MANIFEST} is missing") from None
    except OSError as error:
        raise RunError(f"cannot read checkpoint {path} ({error})") from None
    except (ValueError, RecursionError):
        raise CorruptError(path, f"{MANIFEST} is not JSON") from None
    version = manifest.get("format_version")
    if version is None:
        raise CorruptError(path, f"{MANIFEST} has no format_version")
    if version != FORMAT_VERSION:
        raise RunError(
            f"checkpoint {path} has format {version}, this version reads {FORMAT_VERSION}: use "
            "the version of tangram-rl that wrote it, or start a new run"
        )
    if manifest.get("sha256") != digest:
        raise CorruptError(path, f"checksum of {MANIFEST} differs")
    try:
        return msgspec.convert(body, _Manifest)
    except msgspec.ValidationError as error:
        raise CorruptError(path, f"{MANIFEST}: {error}") from None


def _read_tensors(path: Path, stem: str, files: Mapping[str, str]) -> Tensors:
    name = f"{stem}.safetensors"
    if stem not in files:
        raise RunError(f"checkpoint {path} has no {name}: it was written by another kind of run")
    try:
        data = _content(path / name)
    except FileNotFoundError:
        raise CorruptError(path, f"{name} is missing") from None
    except OSError as error:
        raise RunError(f"cannot read checkpoint {path} ({error})") from None
    if hashlib.sha256(data).hexdigest() != files[stem]:
        raise CorruptError(path, f"checksum of {name} differs")
    try:
        return load_tensors(data, name)
    except WireError as error:
        raise CorruptError(path, str(error)) from None
