"""Who may connect at all: CURVE encryption, its keys, and ZeroMQ's authentication (ZAP).

A run has the server's pair of keys, and one pair that all of its workers share. They live as long
as the run, so that a worker may come back after the master was restarted.
"""

import ipaddress
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import zmq
from zmq.auth.thread import ThreadAuthenticator

from master.counters import Counters
from tangram_agent.files import write_whole
from tangram_sim.errors import ConfigError, RunError

PRIVATE = 0o600
DOMAIN = "tangram"


@dataclass(frozen=True)
class Keys:
    """Two pairs of CURVE keys, 40 characters of Z85 each; the secret ones are never shown."""

    server_public: str
    server_secret: str = field(repr=False)
    worker_public: str
    worker_secret: str = field(repr=False)


def make_keys() -> Keys:
    """Fresh keys."""
    pairs = [*zmq.curve_keypair(), *zmq.curve_keypair()]
    return Keys(*(key.decode("ascii") for key in pairs))


def run_keys(path: Path) -> Keys:
    """The keys of a run; made, and kept in a file that only the user may read, the first time.

    Raises:
        RunError: the file is there and holds something else.
    """
    if not path.exists():
        keys = make_keys()
        write_whole(path, json.dumps(asdict(keys), indent=1).encode(), PRIVATE)
        return keys
    try:
        keys = Keys(**json.loads(path.read_text(encoding="utf-8")))
        for secret, public in (
            (keys.server_secret, keys.server_public),
            (keys.worker_secret, keys.worker_public),
        ):
            if zmq.curve_public(secret.encode()).decode() != public:
                raise ValueError("a public key is not that of its secret key")
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, zmq.ZMQError) as error:
        raise RunError(
            f"{path} does not hold the run's keys ({error}): delete it to make new ones; workers "
            "that run now must then be started again"
        ) from None
    return keys


def needs_keys(bind: str, security: str) -> bool:
    """Whether the sockets must be encrypted: `auto` spares only loopback addresses.

    Raises:
        ConfigError: they must be, and this ZeroMQ cannot.
    """
    wanted = security == "curve" or (security == "auto" and not is_loopback(bind))
    if wanted and not zmq.has("curve"):
        raise ConfigError(
            "this ZeroMQ was built without CURVE: install pyzmq from its wheel, listen on "
            "service.bind=127.0.0.1, or set service.security=plain in a network that you trust"
        )
    return wanted


def is_loopback(bind: str) -> bool:
    """Whether nobody outside this machine can reach an address."""
    try:
        return bind == "localhost" or ipaddress.ip_address(bind).is_loopback
    except ValueError:
        return False  # the name of a host or an interface


class Authenticator:
    """Encrypts sockets of a context, and turns away those with another key."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], keys: Keys, counters: Counters
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
