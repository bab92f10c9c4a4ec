"""A second guard of a run folder, for file systems on which a lock holds on one machine alone.

Whoever works in the folder keeps a file there with its name in it, and touches it every few
seconds. Times are the file system's, so that clocks may differ.
"""

import json
import logging
import os
import secrets
import socket
import time
from contextlib import suppress
from pathlib import Path

from tangram_core.errors import TangramError, UnavailableError
from tangram_core.run.process import Every, still_alive, watching

RENEW_S = 10.0
STALE_S = 60.0  # after which one that is not renewed is nobody's
LOOK_S = 1.0

log = logging.getLogger(__name__)


class LostError(TangramError):
    """Another machine has taken the folder over."""


class Lease:
    """The file of one process, which holds the lock of the same folder on its machine."""

    def __init__(self, path: Path) -> None:
        """Take it, from a process of another machine only after it was silent for long.

        A disk that does not take it is told of, and no reason to stop.

        Raises:
            UnavailableError: a process of another machine works there, perhaps of a job that was
                queued again before this one had ended.
        """
        self._path, self._host, self._id = path, socket.gethostname(), secrets.token_hex(8)
        self._aside = path.with_name(f"{path.name}.{self._id}")
        self._due, self._lost = Every(RENEW_S), ""
        try:
            while not self._made():
                with suppress(FileNotFoundError):  # another process was quicker
                    self._take_away(self._await_silence())
        except OSError as error:
            why = error.strerror
            log.warning("%s cannot be written (%s): other machines are not seen", path, why)
        watching.append(self._keep)  # a checkpoint may take longer than others wait

    def renew(self) -> None:
        """Say that its process lives, where it is time.

        Raises:
            LostError: another machine has the folder now, for good.
        """
        if not self._lost and self._due.due():
            with suppress(OSError):
                self._renew()
        if self._lost:
            raise LostError(f"a process on {self._lost} has taken it over")

    def close(self) -> None:
        """Leave the folder to others, if it is this one's still."""
        watching.remove(self._keep)
        with suppress(OSError):
            if self._holder()[1] == self._id:
                self._path.unlink()

    def _keep(self) -> None:
        with suppress(LostError):  # told when it is asked next
            self.renew()

    def _renew(self) -> None:
        try:
            host, holder = self._holder()
        except FileNotFoundError:  # somebody tidied up
            self._made()
            return
        if holder == self._id:
            os.utime(self._path)
        else:
            self._lost = host

    def _made(self) -> bool:
        """Whether there was none, and there is one now."""
        try:
            self._aside.write_text(json.dumps({"host": self._host, "id": self._id}))
            os.link(self._aside, self._path)  # whole, or not at all
        except FileExistsError:
            return False
        finally:
            self._aside.unlink(missing_ok=True)
        return True

    def _await_silence(self) -> os.stat_result:
        """Whose it is when its process is gone, as the lock tells of one of this machine."""
        host, first = self._holder()[0], _fresh(self._path)
        until_s = time.monotonic() + STALE_S - (self._now_s() - first.st_mtime)
        if host != self._host and time.monotonic() < until_s:
            log.warning("waits whether a process on %s works in %s", host, self._path.parent)
        while host != self._host and time.monotonic() < until_s:
            time.sleep(LOOK_S)
            still_alive()
            if _fresh(self._path).st_mtime != first.st_mtime:
                raise UnavailableError(
                    f"run_dir {self._path.parent} is in use by a process on {host}: choose another "
                    "run_dir, or stop that one first"
                )
        return first

    def _take_away(self, old: os.stat_result) -> None:
        """Put it out of the way, unless another process did, and has its own there by now."""
        self._path.rename(self._aside)
        found = _fresh(self._aside)
        if (found.st_ino, found.st_mtime) != (old.st_ino, old.st_mtime):
            os.link(self._aside, self._path)
        self._aside.unlink()

    def _now_s(self) -> float:
        """By the clock of the file system."""
        self._aside.touch()
        now_s = _fresh(self._aside).st_mtime
        self._aside.unlink()
        return now_s

    def _holder(self) -> tuple[str, str]:
        """Host and id in the file; one that a power cut took the content of is of nobody else."""
        try:
            found = json.loads(self._path.read_bytes())
            return ascii(found["host"])[1:-1], str(found["id"])
        except (ValueError, KeyError, TypeError, RecursionError):
            return self._host, ""


def _fresh(path: Path) -> os.stat_result:
    """As the server has it: NFS keeps what `stat` tells for a while, and asks when it opens."""
    with path.open("rb") as file:
        return os.fstat(file.fileno())
