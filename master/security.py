"""Who may connect at all: CURVE encryption, its keys, and ZeroMQ's authentication (ZAP).

A run has the server's pair of keys, and one pair that all of its workers share. They live as long
as the run, so that a worker may come back after the master was restarted.
"""

import hashlib
import json
import os
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

import zmq
from zmq.auth.thread import ThreadAuthenticator

from master.counters import Counters
from tangram_agent.addresses import IPC, LOCAL
from tangram_agent.config import ServiceConfig
from tangram_agent.files import own_folder, write_whole
from tangram_sim.errors import ConfigError, RunError

PRIVATE = 0o600
DOMAIN = "tangram"
MAX_SOCKET_PATH = 107  # bytes, of Linux


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


def needs_keys(service: ServiceConfig) -> bool:
    """Whether who takes part must show a key: always, but on the sockets of one user.

    Raises:
        ConfigError: this ZeroMQ knows no keys.
    """
    wanted = service.bind != LOCAL and service.auth == "on"
    if wanted and not zmq.has("curve"):
        raise ConfigError(
            "this ZeroMQ was built without CURVE: install pyzmq from its wheel, or leave "
            f"service.bind at {LOCAL}"
        )
    return wanted


def listening_place(bind: str, run: Path) -> str:
    """The address to listen on; for unix sockets the beginning of their paths.

    They lie in a folder that only this user may enter, and not in the run's, whose file system may
    be shared and whose path too long. A run has the same ones in each of its lives.

    Args:
        bind: as it was set.
        run: folder of the run, which is there.

    Raises:
        TangramError: the folder of the sockets cannot be used.
    """
    if bind != LOCAL:
        return bind
    folder, found = Path(tempfile.gettempdir()) / f"tangram-{os.geteuid()}", run.stat()
    own_folder(folder)
    name = hashlib.sha256(f"{run.resolve()} {found.st_dev} {found.st_ino}".encode()).hexdigest()
    place = f"{folder}/{name[:12]}"
    if len(os.fsencode(f"{place}.episodes")) > MAX_SOCKET_PATH:
        raise ConfigError(
            f"{folder} is too long for sockets, whose paths have {MAX_SOCKET_PATH} bytes at most: "
            "set TMPDIR to a shorter one, such as /tmp"
        )
    return IPC + place


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
