"""Who joined, left and was refused: one JSON object a line, in a file that stays bounded."""

import json
import logging
import time
from pathlib import Path
from typing import Any

from tangram_core.errors import TangramError
from tangram_core.store.files import private

# Lines of one event: so many at once, then one in so many seconds. The rest is counted.
BURST, REFILL_S = {"refused": 256}, {"refused": 60.0}
MOST_AT_ONCE, EVERY_S = 8192, 1.0
MAX_BYTES = 8 * 2**20  # then the file becomes NAME.old, in place of the one before
MAX_TEXT = 256

log = logging.getLogger(__name__)


class Audit:
    """The log of a run, or none.

    What the disk does not take is left out, and told: it is not worth a run.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path, self._told = path, False
        self._spent: dict[str, tuple[float, float]] = {}
        self._left_out: dict[str, int] = {}

    def note(self, event: str, **fields: Any) -> None:
        """Write one line, unless there were too many of this event."""
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
    """Add a line to the log of a run; TangramError if the disk does not take it."""
    texts = {n: v[:MAX_TEXT] if isinstance(v, str) else v for n, v in fields.items()}
    now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    line = json.dumps({"time": now, "event": event, **texts})
    try:
        if path.exists() and path.stat().st_size > MAX_BYTES:
            path.replace(path.with_name(f"{path.name}.old"))
        # Whoever knows the id of a process could name it.
        with open(path, "a", encoding="utf-8", opener=private) as file:
            file.write(line + "\n")
    except OSError as error:
        raise TangramError(f"{path} cannot be written ({error.strerror})") from None
