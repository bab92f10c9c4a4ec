"""The audit log: who joined, left or was refused, as JSON lines in a file of bounded size."""

import json
import logging
import time
from pathlib import Path
from typing import Any

from tangram_core.errors import TangramError
from tangram_core.store.files import private

# Lines of one event: BURST at once, then one in REFILL_S seconds. Lines left out are counted.
BURST, REFILL_S = {"refused": 256}, {"refused": 60.0}
MOST_AT_ONCE, EVERY_S = 8192, 1.0
MAX_BYTES = 8 * 2**20  # then the file becomes NAME.old, in place of the one before
MAX_TEXT = 256

log = logging.getLogger(__name__)


class Audit:
    """The audit log of a run; without a path it writes nothing.

    If the disk fails, lines are missing and a warning is logged, but the run goes on.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path, self._told = path, False
        self._spent: dict[str, tuple[float, float]] = {}
        self._left_out: dict[str, int] = {}

    def note(self, event: str, **fields: Any) -> None:
        """Write one line, unless there were too many lines of this event."""
        if self._path is None:
            return
        if not self._may(event):
            self._left_out[event] = self._left_out.get(event, 0) + 1
            return
        left_out = self._left_out.pop(event, 0)
        more = {"left_out": left_out} if left_out else {}
        try:
            write_line(self._path, event, **fields, **more)
            self._told = False
        except TangramError as error:
            if not self._told:
                log.warning("%s: a line of the audit is missing", error)
            self._told = True

    def _may(self, event: str) -> bool:
        now = time.monotonic()
        most = float(BURST.get(event, MOST_AT_ONCE))
        left, since = self._spent.get(event, (most, now))
        left = min(most, left + (now - since) / REFILL_S.get(event, EVERY_S))
        self._spent[event] = (left - 1.0 if left >= 1.0 else left), now
        return left >= 1.0


def write_line(path: Path, event: str, **fields: Any) -> None:
    """Append a line to the audit log of a run; TangramError if the disk cannot be written."""
    texts = {n: v[:MAX_TEXT] if isinstance(v, str) else v for n, v in fields.items()}
    now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    line = json.dumps({"time": now, "event": event, **texts})
    try:
        if path.exists() and path.stat().st_size > MAX_BYTES:
            path.replace(path.with_name(f"{path.name}.old"))
        # Private, because another user could misuse the process ids in the file.
        with open(path, "ab+", opener=private) as file:
            file.seek(max(0, file.tell() - 1))
            half = file.read() not in (b"", b"\n")  # of a line before, as by a full disk
            file.write(b"\n" * half + line.encode() + b"\n")
    except OSError as error:
        raise TangramError(f"{path} cannot be written ({error.strerror})") from None
