"""Checkpoint folders: written completely or not at all, and checked by digests when read.

A checkpoint is a folder with `manifest.json` and one safetensors file for each group of tensors.
Its name is the number of updates in eight digits, with `-1`, `-2`... if the name exists already.
The folder is written under a temporary name, synced, and renamed. So a folder with a checkpoint's
name is complete, unless the disk lost bytes; the checksums in the manifest find that.
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
CHECKPOINTS = "checkpoints"  # folder of the checkpoints in a run's folder
ACTING = "weights"  # stem of the file with the acting weights
SETUP = "setup"  # counter that holds `Setup.contents`
_NAME = re.compile(r"(\d{8,})(?:-(\d+))?")
_TEMPORARY = ".writing-"
_SET_ASIDE = ".corrupt"
_PART = 1 << 24  # bytes between two calls of still_alive

log = logging.getLogger(__name__)

Tensors = dict[str, npt.NDArray[Any]]


class _Manifest(TypedDict):
    """The content of a manifest without its format and checksum."""

    updates: Annotated[int, msgspec.Meta(ge=0)]
    files: dict[str, str]
    counters: dict[str, Any]


class DiskError(RunError):
    """A checkpoint could not be written to the disk."""


class CorruptError(RunError):
    """A checkpoint is damaged; `why` names the file and the fault."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"checkpoint {path} is corrupt ({why}): delete it to use the one before")
        self.path, self.why = path, why


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The content of one checkpoint folder.

    Attributes:
        arrays: file stem -> tensor name -> array, for the stems that were requested.
        counters: the other values, as passed to `save_checkpoint`.
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
    """Write a checkpoint and delete all but the newest `keep`.

    Args:
        folder: folder of all checkpoints of a run; it is created, but its parent must exist.
        arrays: file stem -> tensor name -> array.
        counters: JSON values.

    Raises:
        DiskError: the folder cannot be written; earlier checkpoints are not changed.
    """
    aside = folder / f"{_TEMPORARY}{updates:08d}"
    try:
        make_folders(folder, above=False)
        _delete(folder.glob(f"{_TEMPORARY}*"))
        aside.mkdir()
        _write_content(aside, updates, arrays, counters)
        final = _free_name(folder, updates)
        # The rename makes it a checkpoint; a crash before it leaves the older ones unchanged.
        aside.rename(final)
        sync_folder(folder)
    except OSError as error:
        shutil.rmtree(aside, ignore_errors=True)  # frees disk space for others
        raise DiskError(
            f"cannot write a checkpoint to {folder} ({error}): make room there or choose another "
            "run_dir"
        ) from None
    _delete(list_checkpoints(folder)[:-keep])
    return final


def _delete(folders: Iterable[Path]) -> None:
    """Delete folders; one that cannot be deleted is logged and does no harm."""
    for folder in folders:
        try:
            shutil.rmtree(folder)
        except OSError as error:
            log.warning("%s cannot be deleted (%s): delete it yourself", folder, error.strerror)


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoint folders, oldest first; empty if the folder does not exist."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if _NAME.fullmatch(path.name) and path.is_dir()]
    return sorted(found, key=_order)


def newest_checkpoint(folder: Path) -> Path:
    """The newest checkpoint, whose content is not checked; RunError if there is none."""
    found = list_checkpoints(folder)
    if not found:
        raise RunError(f"no checkpoint in {folder}: train the run first, or name another run_dir")
    return found[-1]


def load_checkpoint(path: Path, stems: Collection[str] | None = None) -> Checkpoint:
    """Read a checkpoint, or only the files named by `stems`.

    Raises:
        CorruptError: a file is missing or damaged; names the file.
        RunError: the checkpoint cannot be read, has another format, or was written without one of
            the files.
    """
    manifest = _read_manifest(path)
    names = manifest["files"] if stems is None else stems
    arrays = {stem: _read_tensors(path, stem, manifest["files"]) for stem in names}
    return Checkpoint(path, manifest["updates"], arrays, manifest["counters"])


def set_aside(path: Path) -> Path:
    """Rename a corrupt checkpoint, so that it is kept but no longer found as a checkpoint.

    Only the newest that was renamed before is kept, too: a bad disk would fill up with them.
    """
    target = path.with_name(path.name + _SET_ASIDE)
    for older in {target, *sorted(path.parent.glob(f"*{_SET_ASIDE}"))[:-1]}:
        shutil.rmtree(older, ignore_errors=True)
    path.rename(target)
    sync_folder(path.parent)
    return target


def was_set_aside(folder: Path) -> bool:
    """Whether `set_aside` renamed a checkpoint in this folder."""
    return any(folder.glob(f"*{_SET_ASIDE}"))


def _order(path: Path) -> tuple[int, int]:
    match = _NAME.fullmatch(path.name)
    if match is None:
        raise RunError(f"{path} is no checkpoint: its name is not a number of updates")
    return int(match[1]), int(match[2] or 0)


def _free_name(folder: Path, updates: int) -> Path:
    """An unused name for this number of updates, as a rename cannot replace a full folder."""
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
        # safetensors writes a view's memory unchanged, so the order must be C.
        content = {name: np.asarray(value, order="C") for name, value in tensors.items()}
        data = safetensors.numpy.save(content)
        _write(aside / f"{stem}.safetensors", data)
        files[stem] = hashlib.sha256(data).hexdigest()
    # Through JSON first, as keys become texts: the reader's digest is of the same values.
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
