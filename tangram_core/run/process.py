"""What every process of the service needs: its parent's end, a watchdog, logs, memory.

No orphans: a child process ends when the process that started it is gone, however it went. The
parent keeps the write end of a pipe for each child and never hands it on, so the kernel closes
it even after SIGKILL. The child inherits the read end, whose number stands in an environment
variable, and a thread waits there for the end of the file. Lines that the parent writes in the
meantime are news for the child's user, since two processes must not draw on one terminal.
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

# Names the file number of the lifeline's read end to the child.
VARIABLE = "TANGRAM_LIFELINE"
GRACE_S = 10.0
# Winding the clock up takes a thread each time.
WIND_S = 1.0
STDERR = 2
FORMATS = ("text", "json")
# Options of glibc's mallopt and their values in bytes; of the second glibc takes no more.
TRIM_THRESHOLD, MMAP_THRESHOLD = (-1, 2**28), (-3, 2**25)
NO_EVENT = "note"


class Lifeline:
    """The parent's side, one for each child.

    Start the child with `pass_fds=(read_end,)` and `environment`, then call `started`, and `cut`
    when the child has ended or shall end.

    Attributes:
        read_end: file number that the child inherits.
    """

    def __init__(self) -> None:
        self.read_end, self._write_end = os.pipe()
        # A child that does not read must not stop its parent.
        os.set_blocking(self._write_end, False)

    def environment(self, base: Mapping[str, str]) -> dict[str, str]:
        """The child's environment."""
        return {**base, VARIABLE: str(self.read_end)}

    def started(self) -> None:
        """Close the read end here: the child has its own now."""
        os.close(self.read_end)

    def tell(self, line: str) -> bool:
        """Send one line to the child; False when it cannot take it."""
        try:
            os.write(self._write_end, f"{line}\n".encode())
        except OSError:
            return False
        return True

    def cut(self) -> None:
        """Close the write end: a child that still lives ends now."""
        os.close(self._write_end)


def watch_parent(on_line: Callable[[str], None] | None = None, grace_s: float = GRACE_S) -> bool:
    """Start the child's side: SIGTERM to itself at the parent's end, and after grace_s the end.

    `on_line` takes each line that the parent sends, in the watching thread.

    Returns:
        Whether there is a parent to watch.

    Raises:
        ConfigError: the variable names no open file.
    """
    # Taken out, so that processes started from here do not watch a parent that is not theirs.
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


WATCHDOG_S = 300.0  # without progress: longer than a large checkpoint on a slow disk
PATIENT_S = 3600.0  # where a compiler runs: minutes for a large update on a busy machine


watching = list[Callable[[], object]]()  # called while something long makes progress


def still_alive() -> None:
    """Tell the process's watchdog, and others who ask, of progress: a disk may be slow for long."""
    for progressed in watching:
        progressed()


class Watchdog:
    """Ends a process that lives but makes no progress, with the stacks of all threads on stderr.

    The clock runs in a thread of C that needs no interpreter, so it also sees a process that hangs
    in an extension. Whoever started the process sees it end, and starts it again. It begins to
    watch when it is entered; 0 seconds is never.
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
        """The process is alive: count the seconds anew; cheap enough for every turn of a loop."""
        if self._seconds and time.monotonic() - self._wound_s >= WIND_S:
            self._wind()

    @contextmanager
    def patient(self, seconds: float = PATIENT_S) -> Iterator[None]:
        """What is done within may take so long without progress."""
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
    """These signals call a function, until what was there before is put back.

    Not those that are ignored: nohup and scripts let children ignore some.
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
    """Keep memory that was freed for what comes next; other C libraries than glibc do as they do.

    An update frees tens of megabytes at its end, and so does a picture that was looked at. glibc
    hands them back to the system. To get them again, page by page, takes a sixth of an update of
    attention, and a tenth of an episode in which tokens are seen.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(*TRIM_THRESHOLD)
        mallopt(*MMAP_THRESHOLD)


def formatter(log_format: str, who: str) -> logging.Formatter:
    """How a process writes its lines, in one of `FORMATS`.

    JSON lines have `time` (ISO 8601, UTC), `level`, `process`, `event`, `message`, and the fields
    of the event, which callers give to the logger as `extra`.
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
    """An interval of a loop: `due` is true at most once in it."""

    def __init__(self, seconds: float, at_once: bool = False) -> None:
        self._seconds = seconds
        self._next_s = 0.0 if at_once else time.monotonic() + seconds

    def due(self) -> bool:
        """Whether the interval has passed; starts the next one if so."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + self._seconds
        return True

    def rest(self, seconds: float) -> None:
        """Not to be due for so long from now, if that is longer than it would be."""
        self._next_s = max(self._next_s, time.monotonic() + seconds)
