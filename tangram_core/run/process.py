"""Tools of every process of the service: lifeline to the parent, watchdog, logs, memory.

No orphans: a child process ends when its parent is gone, for whatever reason. The parent keeps the
write end of a pipe for each child and passes it to no process, so the kernel closes it even after
SIGKILL. The child inherits the read end, whose number is in an environment variable. A thread of
the child waits there for the end of the file. The parent may write lines before, which the child
shows to the user, since two processes must not draw on one terminal.
"""

import ctypes
import faulthandler
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Self

from pythonjsonlogger.json import JsonFormatter

from tangram_core.errors import ConfigError

# Environment variable with the file number of the lifeline's read end.
VARIABLE = "TANGRAM_LIFELINE"
GRACE_S = 10.0
# Restarting the clock of faulthandler starts a thread each time.
WIND_S = 1.0
STDERR = 2
FORMATS = ("text", "json")
# Options of glibc's mallopt and their values in bytes; glibc allows no more for the second.
TRIM_THRESHOLD, MMAP_THRESHOLD = (-1, 2**28), (-3, 2**25)
NO_EVENT = "note"


class Lifeline:
    """The parent's end of the pipe to one child.

    Start the child with `pass_fds=(read_end,)` and `environment`, then call `started`. Call `cut`
    when the child has ended, or to end it.

    Attributes:
        read_end: file number that the child inherits.
    """

    def __init__(self) -> None:
        self.read_end, self._write_end = os.pipe()
        # A child that does not read must not block its parent.
        os.set_blocking(self._write_end, False)

    def environment(self, base: Mapping[str, str]) -> dict[str, str]:
        """The environment variables for the child: `base` and the number of the read end."""
        return {**base, VARIABLE: str(self.read_end)}

    def started(self) -> None:
        """Close the parent's copy of the read end, after the child has started."""
        os.close(self.read_end)

    def tell(self, line: str) -> bool:
        """Send one line to the child; False if the pipe is full or closed."""
        try:
            os.write(self._write_end, f"{line}\n".encode())
        except OSError:
            return False
        return True

    def cut(self) -> None:
        """Close the write end, which ends a child that still lives."""
        os.close(self._write_end)


def watch_parent(on_line: Callable[[str], None] | None = None, grace_s: float = GRACE_S) -> bool:
    """Watch the parent in a thread: when it is gone, send SIGTERM to this process, then exit.

    Args:
        on_line: called in the watching thread with each line that the parent sends.
        grace_s: seconds between SIGTERM and the exit.

    Returns:
        Whether there is a parent to watch.

    Raises:
        ConfigError: the environment variable names no open file.
    """
    # Removed, so that children of this process do not watch its parent.
    value = os.environ.pop(VARIABLE, None)
    if value is None:
        return False
    try:
        handle = int(value)
        os.set_inheritable(handle, False)
    except (ValueError, OSError):
        raise ConfigError(
            f"{VARIABLE} must be the number of an open file, got '{value}': unset it"
        ) from None
    thread = threading.Thread(
        target=_wait, args=(handle, on_line, grace_s), name="lifeline", daemon=True
    )
    thread.start()
    return True


def _wait(handle: int, on_line: Callable[[str], None] | None, grace_s: float) -> None:
    with os.fdopen(handle, encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if on_line is not None:
                on_line(line.rstrip("\n"))
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(grace_s)
    os._exit(1)


WATCHDOG_S = 300.0  # without progress; writing a large checkpoint to a slow disk takes less
PATIENT_S = 3600.0  # while compiling, which takes minutes for a large update on a busy machine


watching = list[Callable[[], object]]()  # functions that `still_alive` calls


def still_alive() -> None:
    """Tell the functions in `watching` that a long task, as writing to a slow disk, goes on."""
    for progressed in watching:
        progressed()


class Watchdog:
    """Ends this process if it makes no progress, and prints the stacks of all threads to stderr.

    The clock runs in a C thread without the interpreter, so it also ends a process that hangs in an
    extension. The parent sees the end and starts the process again. The watchdog is a context
    manager and watches inside the `with`; with 0 seconds it does nothing.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds, self._wound_s = seconds, 0.0

    def __enter__(self) -> Self:
        self._wind()
        watching.append(self.progress)
        return self

    def __exit__(self, *_: object) -> None:
        watching.remove(self.progress)
        if self._seconds:
            faulthandler.cancel_dump_traceback_later()

    def progress(self) -> None:
        """Restart the clock; cheap enough to be called in every turn of a loop."""
        if self._seconds and time.monotonic() - self._wound_s >= WIND_S:
            self._wind()

    @contextmanager
    def patient(self, seconds: float = PATIENT_S) -> Iterator[None]:
        """Allow `seconds` without progress inside the `with`."""
        self._wind(seconds)
        try:
            yield
        finally:
            self._wind()

    def _wind(self, seconds: float | None = None) -> None:
        if self._seconds:
            self._wound_s = time.monotonic()
            faulthandler.dump_traceback_later(seconds or self._seconds, exit=True, file=STDERR)


@contextmanager
def handling(
    handle: Callable[[signal.Signals], None], numbers: Iterable[signal.Signals]
) -> Iterator[None]:
    """Handle signals with a function inside the `with`; then restore the earlier handlers.

    Signals that are ignored stay ignored: nohup and scripts make children ignore some.
    """
    before = {
        number: signal.signal(number, lambda n, _frame: handle(signal.Signals(n)))
        for number in numbers
        if signal.getsignal(number) != signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def keep_memory() -> None:
    """Make glibc keep freed memory for later use; other C libraries are not changed.

    An update frees tens of megabytes at its end, and so does the reading of a picture. By default
    glibc returns them to the system. Getting them back page by page takes a sixth of an update of
    an attention network, and a tenth of an episode with pictures.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(*TRIM_THRESHOLD)
        mallopt(*MMAP_THRESHOLD)


def formatter(log_format: str, who: str) -> logging.Formatter:
    """The formatter of a process's log lines.

    JSON lines have `time` (ISO 8601, UTC), `level`, `process`, `event`, `message`, and the fields
    of the event, which callers give to the logger as `extra`.

    Args:
        log_format: one of `FORMATS`.
        who: name of the process.
    """
    if log_format == "json":
        return JsonFormatter(
            ("levelname", "message"),
            rename_fields={"levelname": "level"},
            static_fields={"process": who},
            defaults={"event": NO_EVENT},
            timestamp="time",
        )
    return logging.Formatter(f"%(asctime)s {who}: %(message)s", "%H:%M:%S")


class Every:
    """A timer for loops: `due` is true at most once in each interval. A suspend counts."""

    def __init__(self, seconds: float, at_once: bool = False) -> None:
        self._seconds = seconds
        self._next_s = 0.0 if at_once else time.clock_gettime(time.CLOCK_BOOTTIME) + seconds

    def due(self) -> bool:
        """Whether the interval has passed; if so, the next one starts."""
        now_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        if now_s < self._next_s:
            return False
        self._next_s = now_s + self._seconds
        return True

    def rest(self, seconds: float) -> None:
        """Delay the next `due` to at least this many seconds from now."""
        self._next_s = max(self._next_s, time.clock_gettime(time.CLOCK_BOOTTIME) + seconds)


@contextmanager
def quiet(*numbers: int) -> Iterator[None]:
    """Discard what C code writes to these file numbers (1 stdout, 2 stderr), not to sys.stdout."""
    try:
        kept = {number: os.dup(number) for number in numbers}
    except OSError:  # this process has none
        yield
        return
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for number in kept:
            os.dup2(null, number)
        yield
    finally:
        for number, old in kept.items():
            os.dup2(old, number)
            os.close(old)
        os.close(null)
