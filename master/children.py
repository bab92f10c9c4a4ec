"""Child processes that end with their parent, and are started again when they fail."""

import os
import select
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from threading import Thread

import psutil

from master.forking import Body, run_command, start
from tangram_core.errors import UNAVAILABLE_STATUS, USAGE_STATUS
from tangram_core.run.process import Lifeline

# A process that lived for so long starts with a clean record.
STEADY_S = 60.0
MAX_RESTARTS = 5
FIRST_DELAY_S = 0.5
MAX_DELAY_S = 30.0
MAX_WAIT_S = 300.0  # for what the environment lacks, however often
HUNG_STATUS = 1  # of a watchdog, though others use it, too
TAIL_LINES = 12


@dataclass(eq=False)
class Child:
    """One process, or several one after another in the same place.

    Attributes:
        arguments: the name of a command, and its own.
        log: file that its output is appended to, None for the terminal.
        nice: added to its niceness.
        patience_s: without progress before its watchdog ends it, 0 for none.
        restarts: in a row, without a steady time between.
        wait_s: until the next start, where the environment lacks something, else 0.
        next_start_s: monotonic time of the next start, None while nothing is planned.
        body: what runs in the process with the arguments.
    """

    name: str
    arguments: Sequence[str]
    log: Path | None = None
    nice: int = 0
    patience_s: float = 0.0
    restarts: int = 0
    wait_s: float = 0.0
    next_start_s: float | None = 0.0
    body: Body = run_command
    _process: ForkServerProcess | None = field(default=None, init=False)
    _handle: int | None = field(default=None, init=False)
    _lifeline: Lifeline | None = field(default=None, init=False)
    _started_s: float = field(default=0.0, init=False)
    _frozen_s: float = field(default=0.0, init=False)

    @property
    def alive(self) -> bool:
        """Whether a process runs here."""
        return self._handle is not None and not _has_ended(self._handle, wait=False)

    @property
    def kept(self) -> bool:
        """Whether a process is here, if only its end that nobody cleared, or is planned."""
        return self._process is not None or self.next_start_s is not None

    def start(self, ended: Callable[["Child"], None]) -> None:
        """Start a process; `ended` is called with this, in another thread, when it ends.

        Raises:
            TangramError: no process can be started; UnavailableError where one may be later.
        """
        self.next_start_s, self._started_s, self._frozen_s = None, time.monotonic(), 0.0
        self._lifeline = Lifeline()
        told = self.body, self.arguments, self.log, self.nice, self._lifeline.read_end
        try:
            self._process = start(*told)
        finally:
            self._lifeline.started()
        self._handle = _handle(self._process)
        Thread(target=self._wait, args=(os.dup(self._handle), ended), daemon=True).start()

    def clear(self) -> int:
        """Forget a process that has ended; returns its exit status, 0 where there is none."""
        status = 0
        if self._lifeline is not None:
            self._lifeline.cut()
        if self._process is not None:
            self._process.join()
            status = self._process.exitcode or 0
        if self._handle is not None:
            os.close(self._handle)
        self._process, self._handle, self._lifeline = None, None, None
        return status

    def plan_restart(self, status: int) -> bool:
        """Plan the next start with a growing delay; False to give up.

        Status 2 is wrong input, which does not mend itself. What 75 tells of may take an hour, and
        is no failure of the process.
        """
        now_s = time.monotonic()
        # One that hung from its beginning lived for as long as its watchdog let it.
        hung = status == HUNG_STATUS or self._frozen_s > 0.0
        if now_s - self._started_s >= STEADY_S + (self.patience_s if hung else 0.0):
            self.restarts, self.wait_s = 0, 0.0
        if status == UNAVAILABLE_STATUS:
            self.wait_s = min(max(2.0 * self.wait_s, FIRST_DELAY_S), MAX_WAIT_S)
            self.next_start_s = now_s + self.wait_s
            return True
        self.wait_s = 0.0
        if status == USAGE_STATUS or self.restarts >= MAX_RESTARTS:
            return False
        delay_s = min(FIRST_DELAY_S * 2.0**self.restarts, MAX_DELAY_S)
        self.restarts += 1
        self.next_start_s = now_s + delay_s
        return True

    @property
    def plan(self) -> str:
        """The next start in words."""
        return f"in {self.wait_s:g} s" if self.wait_s else f"{self.restarts} of {MAX_RESTARTS}"

    def tell(self, line: str) -> bool:
        """Send a line to the process; False where it cannot take it."""
        return self._lifeline is not None and self._lifeline.tell(line)

    def kill_frozen(self, passed_s: float) -> bool:
        """Kill a process that has been stopped (SIGSTOP) for too long: so has its watchdog.

        Args:
            passed_s: since this was called last; time in which the caller was stopped, as with a
                whole job, does not count.

        Returns:
            Whether it was killed.
        """
        frozen = self._process is not None and _is_stopped(self._process.pid or 0)
        self._frozen_s = self._frozen_s + passed_s if frozen else 0.0
        if not 0.0 < self.patience_s <= self._frozen_s:
            return False
        self.signal(signal.SIGKILL)
        return True

    def signal(self, number: signal.Signals) -> None:
        """Send a signal, if the process still runs."""
        if self._process is not None and self.alive:
            with suppress(ProcessLookupError):
                os.kill(self._process.pid or 0, number)

    def tail(self, count: int = TAIL_LINES) -> str:
        """The last lines of its log."""
        if self.log is None or not self.log.exists():
            return ""
        lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(lines[-count:])

    def _wait(self, handle: int, ended: Callable[["Child"], None]) -> None:
        _has_ended(handle, wait=True)
        os.close(handle)
        ended(self)


def _handle(process: ForkServerProcess) -> int:
    """A file that can be read once the process has ended.

    Where the kernel has none (before 5.3), one of its server, whose end looks the same.
    """
    try:
        return os.pidfd_open(process.pid or 0)
    except OSError:
        return os.dup(process.sentinel)


def _has_ended(handle: int, *, wait: bool) -> bool:
    poll = select.poll()
    poll.register(handle, select.POLLIN)
    return bool(poll.poll(None if wait else 0))


def _is_stopped(pid: int) -> bool:
    """Whether there is such a process, and a signal has stopped it."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_STOPPED
    except psutil.Error:
        return False


def describe(status: int) -> str:
    """An exit status in words."""
    if status >= 0:
        return f"status {status}"
    try:
        return signal.Signals(-status).name
    except ValueError:
        return f"signal {-status}"
