"""PyBullet, imported without the line about its build that it prints."""

import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

from tangram_core.errors import TangramError


@contextmanager
def _quiet() -> Iterator[None]:
    """Discard what C code writes to stderr; replacing sys.stderr does not affect C code."""
    try:
        kept = os.dup(2)
    except OSError:  # this process has no stderr
        yield
        return
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)


with _quiet():
    import pybullet

__all__ = ["Client", "pybullet"]


class Client:
    """A new PyBullet client in DIRECT mode; base class of all that moves bodies.

    Attributes:
        client: number of the client.
    """

    def __init__(self) -> None:
        self.client: int = pybullet.connect(pybullet.DIRECT)
        if self.client < 0:
            raise TangramError(
                "PyBullet has no client left (it offers 1024 in one process): close environments, "
                "or use fewer of them"
            )
        self._finalizer = weakref.finalize(self, pybullet.disconnect, self.client)

    def close(self) -> None:
        """Disconnect the client; further calls do nothing."""
        self._finalizer()
