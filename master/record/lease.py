"""A lease on a run folder, for network file systems where `flock` works on one machine only.

The process that uses the folder keeps a file there with its host name, the boot id of its machine
and an id of its own, and touches the file every few seconds. Whoever wants the folder watches the
file for `STALE_S` by a clock that is never set, so no clock of the day decides.
"""

import json
import logging
import os
import secrets
import socket
import time
from contextlib import suppress
from pathlib import Path

from tangram_core.errors import FailedError, UnavailableError
from tangram_core.run.process import Every, still_alive, watching

RENEW_S = 10.0
STALE_S = 60.0  # a lease that nobody renewed while it was watched for this time may be taken over
LOOK_S = 1.0
BOOT = Path("/proc/sys/kernel/random/boot_id")  # host names may be equal on several machines

log = logging.getLogger(__name__)


def is_elsewhere(path: Path) -> bool:
    """Whether a process on another machine has the lease; OSError if there is none."""
    return _holder(path)[1] != BOOT.read_text().strip()


class Lease:
    """The lease of one process, which must hold the lock (`flock`) of the folder, too."""

    def __init__(self, path: Path) -> None:
        """Take the lease; wait `STALE_S` if a process on another machine seems to have it.

        If the file cannot be written, a warning is logged and the process goes on without a lease.

        Raises:
            UnavailableError: a process on another machine uses the folder. It may belong to a job
                that was requeued before it had ended.
        """
        self._path, self._id = path, secrets.token_hex(8)
        self._host, self._machine = socket.gethostname(), BOOT.read_text().strip()
        self._aside = path.with_name(f"{path.name}.{self._id}")
        self._due, self._lost, self._silent = Every(RENEW_S), "", Every(STALE_S)
        try:
            while not self._made():
                with suppress(FileNotFoundError, FileExistsError):  # another was quicker
                    self._take_away(self._await_silence())
        except OSError as error:
            why = error.strerror
            log.warning("%s cannot be written (%s): other machines are not seen", path, why)
        watching.append(self.renew)  # writing a checkpoint may take longer than STALE_S

    def renew(self) -> None:
        """Touch the file if that is due.

        Raises:
            FailedError: another machine has the folder now; each later call raises this again.
        """
        if not self._lost and self._due.due():
            with suppress(OSError):
                self._renew()
        if self._lost:
            lost = f"run_dir {self._path.parent} is lost"
            raise FailedError(f"{lost}: a process on {self._lost} has taken it over")

    def close(self) -> None:
        """Delete the file if this process still has the lease."""
        watching.remove(self.renew)
        with suppress(OSError):
            if _holder(self._path)[2] == self._id:
                self._path.unlink()

    def _renew(self) -> None:
        try:
            host, machine, holder = _holder(self._path)
        except FileNotFoundError:
            host, machine, holder = "", self._machine, ""
        silent, self._silent = self._silent, Every(STALE_S)
        if holder == self._id:
            os.utime(self._path)
        elif machine != self._machine or silent.due():  # another may have had it, and ended
            self._lost = host or "another machine"
        else:  # deleted, damaged, or of a process that has ended
            self._path.unlink(missing_ok=True)
            self._made()

    def _made(self) -> bool:
        """Make the file; False if another process has one."""
        try:
            mine = {"host": self._host, "machine": self._machine, "id": self._id}
            self._aside.write_text(json.dumps(mine))
            os.link(self._aside, self._path)  # atomic: no other process sees a partial file
        except FileExistsError:
            return False
        finally:
            self._aside.unlink(missing_ok=True)
        return True

    def _await_silence(self) -> os.stat_result:
        """Watch the holder's file for `STALE_S`, and return the file's status.

        No wait for a holder on this machine: the lock shows that its process has ended.
        """
        (host, machine, _), first = _holder(self._path), _fresh(self._path)
        until_s = time.monotonic() + STALE_S
        if machine != self._machine:
            log.warning("waiting to see if a process on %s uses %s", host, self._path.parent)
        while machine != self._machine and time.monotonic() < until_s:
            time.sleep(LOOK_S)
            still_alive()
            if _fresh(self._path).st_mtime != first.st_mtime:
                raise UnavailableError(
                    f"run_dir {self._path.parent} is in use by a process on {host}: choose another "
                    "run_dir, or stop that one first"
                )
        return first

    def _take_away(self, old: os.stat_result) -> None:
        """Remove a stale file; put the file back if another process has replaced it by now."""
        self._path.rename(self._aside)
        found = _fresh(self._aside)
        if (found.st_ino, found.st_mtime) != (old.st_ino, old.st_mtime):
            os.link(self._aside, self._path)
        self._aside.unlink()


def _holder(path: Path) -> tuple[str, str, str]:
    """Host, machine and id in the file; this machine and no id if a power cut damaged it."""
    try:
        found = json.loads(path.read_bytes())
        return ascii(found["host"])[1:-1], str(found.get("machine")), str(found["id"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return socket.gethostname(), BOOT.read_text().strip(), ""


def _fresh(path: Path) -> os.stat_result:
    """The status of a file as the server has it: NFS caches `stat`, but asks again on open."""
    with path.open("rb") as file:
        return os.fstat(file.fileno())
