"""A console that outlives its terminal."""

import os
from typing import Any, TextIO, cast

from rich.console import Console


class _Sturdy:
    """A text file that turns into the null device when its reader is gone, and shows what it can.

    A closed terminal or pipe must not end a run that goes on without anybody watching, nor a clean
    end that has still to be written down.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, text: str) -> int:
        try:
            return self._file.write(text)
        except UnicodeEncodeError:  # a terminal that knows fewer characters, such as LC_ALL=C
            known = text.encode(self._file.encoding, "replace")
            return self._file.write(known.decode(self._file.encoding))
        except OSError:
            return self._silence(text)

    def flush(self) -> None:
        try:
            self._file.flush()
        except OSError:
            self._silence("")

    def _silence(self, text: str) -> int:
        null = os.open(os.devnull, os.O_WRONLY)
        # Under the buffered file, whose rest is written at the interpreter's end at the latest.
        os.dup2(null, self._file.fileno())
        os.close(null)
        return len(text)


def sturdy_console(file: TextIO) -> Console:
    """A console on stdout or stderr that falls silent instead of failing."""
    return Console(file=cast(TextIO, _Sturdy(file)))
