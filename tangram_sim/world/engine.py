"""PyBullet, imported without the line about its build that it prints."""

import weakref

from tangram_core.errors import TangramError
from tangram_core.run.process import quiet

with quiet(2):
    import pybullet

__all__ = ["Client", "pybullet"]


class Client:
    """A new PyBullet client in DIRECT mode; base class of all that moves bodies.

    Attributes:
        client: PyBullet's id of this client, its `physicsClientId`.
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
