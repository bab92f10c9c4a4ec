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
from tangram_core.errors import FAILED_STATUS, UNAVAILABLE_STATUS, USAGE_STATUS
from tangram_core.run.process import Lifeline

# After a life of this length, earlier restarts are not counted.
STEADY_S = 60.0
MAX_RESTARTS = 5
FIRST_DELAY_S = 0.5
MAX_DELAY_S = 30.0
MAX_WAIT_S = 300.0  # for something that the environment lacks; these restarts have no limit
TAIL_LINES = 12


@dataclass(eq=False)
class Child:
    """A child process and its restarts.

    Attributes:
        name: of the child, for log lines.
        arguments: the name of a command, then the command's arguments.
        log: file to which the output is appended; None for the terminal.
        nice: added to the niceness of the process.
        patience_s: seconds without progress after which the watchdog ends the process; 0 for none.
        restarts: number of restarts in a row without `STEADY_S` between them.
        wait_s: seconds until the next start if the environment lacks something, else 0.
        next_start_s: monotonic time of the next start; None while no start is planned.
        body: function that the process calls with the arguments.
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
        """Whether the process is running."""
        return self._handle is not None and not _has_ended(self._handle, wait=False)

    @property
    def kept(self) -> bool:
        """Whether there is a process (running, or ended and not cleared) or a planned start."""
        return self._process is not None or self.next_start_s is not None

    def start(self, ended: Callable[["Child"], None]) -> None:
        """Start a process; when it ends, call `ended` with this child, in another thread.

        Raises:
            TangramError: no process can be started; UnavailableError if a later start may succeed.
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
        """Forget a process that has ended; returns its exit status, 0 if there was no process."""
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

        Status 2 means wrong input, so another start would fail, too. Status 75 means that
        something outside the process is missing, perhaps for an hour: retry without a limit.
        """
        now_s = time.monotonic()
        # A process that hung from the start still lives until its watchdog ends it.
        hung = status == FAILED_STATUS or self._frozen_s > 0.0
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
        """Send a line of text to the process; False if it cannot receive the line."""
        return self._lifeline is not None and self._lifeline.tell(line)

    def kill_frozen(self, passed_s: float) -> bool:
        """Kill a process that SIGSTOP has stopped for too long; its watchdog is stopped, too.

        Args:
            passed_s: seconds since the last call. Leave out the time in which the caller itself was
                stopped, as when a whole job is stopped.

        Returns:
            Whether the process was killed.
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
        """The last lines of the log; empty if there is none."""
        try:
            text = self.log.read_text(encoding="utf-8", errors="replace") if self.log else ""
        except OSError:  # none yet, or the disk failed
            return ""
        return "\n".join(text.splitlines()[-count:])

    def _wait(self, handle: int, ended: Callable[["Child"], None]) -> None:
        _has_ended(handle, wait=True)
        os.close(handle)
        ended(self)


def _handle(process: ForkServerProcess) -> int:
    """A file descriptor that becomes readable when the process has ended.

    Before Linux 5.3 there is no pidfd; a pipe of the fork server then behaves the same way.
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
    """Whether the process exists and a signal has stopped it."""
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
