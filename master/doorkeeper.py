"""Who may connect at all: with CURVE, whoever has the key of the run's workers."""

import zmq
from zmq.auth.thread import ThreadAuthenticator

from master.keys import Keys
from master.tally import Tally

DOMAIN = "tangram"


class Doorkeeper:
    """Encrypts sockets of a context, and turns away those with another key; see ZeroMQ's ZAP."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], keys: Keys, counters: Tally
    ) -> None:
        self._keys, self._counters = keys, counters
        self._thread = ThreadAuthenticator(context)
        self._thread.start()
        self._thread.configure_curve_callback(domain=DOMAIN, credentials_provider=self)

    def guard(self, socket: zmq.Socket[bytes]) -> None:
        """Encrypt a socket that is not bound yet."""
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self._keys.server_secret.encode())
        socket.setsockopt_string(zmq.ZAP_DOMAIN, DOMAIN)

    def callback(self, _domain: str, key: bytes) -> bool:
        """Whether a key (Z85) may connect; called by the thread."""
        allowed = key == self._keys.worker_public.encode()
        if not allowed:
            self._counters.note("refused_keys", "a worker with the key of another run")
        return allowed

    def close(self) -> None:
        """End the thread, before the context is destroyed."""
        self._thread.stop()
