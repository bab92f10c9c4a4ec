"""Ports for tests that must name one before anybody listens there."""

import random
import socket
from contextlib import ExitStack, suppress

# Below those that the system gives to whoever asks for any: nobody else is there a moment later.
_PORTS = range(10_000, 32_000)


def free_ports(count: int) -> int:
    """The first of so many in a row that nobody listens on."""
    while True:
        port = random.SystemRandom().choice(_PORTS)
        with ExitStack() as opened, suppress(OSError):
            for more in range(count):
                opened.enter_context(socket.create_server(("127.0.0.1", port + more)))
            return port
