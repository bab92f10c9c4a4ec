"""Atomic, durable writes of files: a reader sees the old content or the new, never a part."""

import os
import stat
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile

from tangram_core.errors import ConfigError, RunError

PUBLIC, PRIVATE = 0o644, 0o600


def write_whole(path: Path, data: bytes, mode: int = PUBLIC, above: bool = True) -> None:
    """Write a file atomically; after an error nothing is left behind.

    Args:
        path: the file, new or to be replaced.
        data: whole content.
        mode: permissions of the file.
        above: whether missing folders are created.

    Raises:
        RunError: the disk is full or the folder cannot be written.
    """
    aside = _aside(path)
    try:
        if above:
            make_folders(path.parent)
        try:
            aside.unlink(missing_ok=True)
            handle = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(handle)
            aside.replace(path)
            sync_folder(path.parent)
        finally:
            aside.unlink(missing_ok=True)
    except OSError as error:
        raise RunError(
            f"cannot write {path} ({error.strerror}): make room there or choose another folder"
        ) from None


def make_folders(folder: Path, above: bool = True) -> None:
    """Create a folder, and with `above` its missing parents, and sync its name to the disk.

    Raises:
        OSError: the folder cannot be created.
    """
    try:
        folder.mkdir(exist_ok=True)
    except FileNotFoundError:
        if not above or folder == folder.parent:
            raise
        make_folders(folder.parent)
        folder.mkdir(exist_ok=True)
    # Also for a folder that exists: a kill may have come before the sync. A parent without
    # permission to read belongs to another user.
    with suppress(PermissionError):
        sync_folder(folder.parent)


def private(path: str, flags: int) -> int:
    """Opener for `open`: only this user may access the file, also if it exists already."""
    handle = os.open(path, flags, 0o600)
    os.fchmod(handle, 0o600)
    return handle


def check_writable(name: str, path: Path) -> None:
    """Raise ConfigError, which names the setting, if `write_whole` cannot write to the path."""
    try:
        if path.is_dir():
            raise IsADirectoryError(0, "it is a folder")
        _aside(path).exists()  # raises if the name is too long
        with TemporaryFile(dir=next(folder for folder in path.parents if folder.exists())):
            pass
    except OSError as error:
        raise ConfigError(
            f"{name}={path} cannot be written ({error.strerror}): name a file in a folder that "
            "you may write to"
        ) from None


def own_folder(path: Path) -> None:
    """Create a folder that only this user may enter, or check an existing one.

    Raises:
        RunError: the folder cannot be created, or others may enter it.
    """
    try:
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        check_own(path)
    except OSError as error:
        raise RunError(
            f"{path} cannot be made ({error.strerror}): set TMPDIR to a folder that you may write "
            "to, for the master and its workers"
        ) from None


def check_own(path: Path) -> None:
    """Check that only this user may enter a folder.

    Raises:
        RunError: it belongs to another user, is open to others, or is no folder.
        OSError: it does not exist, or its permissions cannot be read.
    """
    found = path.lstat()
    mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()
    if not mine or found.st_mode & 0o077:
        is_now = f"{stat.filemode(found.st_mode)} of user {found.st_uid}"
        raise RunError(
            f"{path} must be a folder that only this user may enter, it is {is_now}: remove it, or "
            "set TMPDIR to a folder of your own"
        )


def _aside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}")


def sync_folder(folder: Path) -> None:
    """Sync the names in a folder to the disk; else a power cut could undo a rename."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def is_same(handle: int, path: Path) -> bool:
    """Whether a path still names this open file or folder."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except OSError:
        return False
