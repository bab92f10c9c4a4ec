"""No orphans: a child process ends when the process that started it is gone, however it went.

The parent keeps the write end of a pipe for each child and never hands it on, so the kernel closes
it even after SIGKILL. The child inherits the read end, whose number stands in an environment
variable, and a thread waits there for the end of the file. Lines that the parent writes in the
meantime are news for the child's user, since two processes must not draw on one terminal.
"""

import os
import signal
import threading
from collections.abc import Callable, Mapping

from tangram_sim.errors import ConfigError

VARIABLE = "TANGRAM_LIFELINE"
GRACE_S = 10.0


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


def watch(on_line: Callable[[str], None] | None = None, grace_s: float = GRACE_S) -> bool:
    """Start the child's side: SIGTERM to itself at the parent's end, and after grace_s the end.

    Args:
        on_line: takes each line that the parent sends; called in the watching thread.
        grace_s: seconds that an orderly end may take.

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
