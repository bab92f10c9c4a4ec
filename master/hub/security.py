"""Who may connect at all: CURVE encryption, its keys, and ZeroMQ's authentication (ZAP).

A run has the server's pair of keys, one for each role that its own workers share, and those that
tangram-keys made for others. They live as long as the run, so that a worker may come back after the
master was restarted.
"""

import hashlib
import json
import logging
import os
import re
import socket
import struct
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import zmq
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils import z85

from master.record.audit import Audit
from master.record.counters import Counters
from tangram_core.errors import UNREADABLE, ConfigError, RunError
from tangram_core.run.process import Every
from tangram_core.run.service import ServiceConfig
from tangram_core.store.files import own_folder, write_whole
from tangram_core.wire.addresses import IPC, LOCAL
from tangram_core.wire.messages import ROLES

PRIVATE = 0o600
DOMAIN = "tangram"
MAX_SOCKET_PATH = 107  # bytes, of Linux
NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,63}")  # of a key
KEY_BYTES = 32
STALE_S = 24 * 3600.0  # of a socket that nobody listens on
LOOK_S = 1.0  # between two looks at the file of keys

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Pair:
    """CURVE keys, 40 characters of Z85 each; the secret one is never shown."""

    public: str
    secret: str = field(repr=False)


@dataclass(frozen=True)
class Given:
    """A key for a role that was made for somebody, who alone has its secret half."""

    role: str
    public: str


@dataclass(frozen=True)
class Keys:
    """The keys of a run: of the master, of its own workers by role, and those that were given.

    Attributes:
        given: name -> key, of those that tangram-keys made.
        path: where they are kept; changes there are followed.
    """

    server: Pair
    player: Pair
    evaluator: Pair
    given: Mapping[str, Given] = field(default_factory=dict)
    path: Path | None = field(default=None, compare=False)

    def own(self) -> dict[str, Pair]:
        """Role -> the pair of the run's own workers."""
        return {role: getattr(self, role) for role in ROLES}

    def content(self) -> dict[str, Any]:
        """As the file holds them."""
        return {name: value for name, value in asdict(self).items() if name != "path"}


@dataclass(frozen=True)
class Holder:
    """Who has a key.

    Attributes:
        name: empty where there are no keys.
        role: it is for; empty for any, where there are no keys.
        revoked: it was valid before.
    """

    name: str = ""
    role: str = ""
    revoked: bool = False


def make_pair() -> Pair:
    """A fresh one."""
    return Pair(*(key.decode("ascii") for key in zmq.curve_keypair()))


def make_keys() -> Keys:
    """Fresh keys."""
    return Keys(make_pair(), make_pair(), make_pair())


def holders(keys: Keys) -> dict[str, Holder]:
    """Public key -> who has it."""
    own = {pair.public: Holder(role, role) for role, pair in keys.own().items()}
    return own | {one.public: Holder(name, one.role) for name, one in keys.given.items()}


def run_keys(path: Path) -> Keys:
    """The keys of a run, see `read_keys`; made, for the user alone to read, the first time."""
    if not path.exists():
        write_keys(path, make_keys())
    return read_keys(path)


def read_keys(path: Path) -> Keys:
    """The keys in a file; RunError if it holds something else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        keys = msgspec.convert(content, Keys)
        if keys.content() != content:
            raise ValueError("it holds more")
        for pair in (keys.server, *keys.own().values()):
            if zmq.curve_public(pair.secret.encode()).decode() != pair.public:
                raise ValueError("a public key is not that of its secret key")
        for name, one in keys.given.items():
            if not NAME.fullmatch(name) or name in ROLES or one.role not in ROLES:
                raise ValueError(f"'{name}' is no name, or its role is unknown")
            if len(z85.decode(one.public)) != KEY_BYTES:
                raise ValueError(f"the key of {name} is none")
    except (*UNREADABLE, struct.error, msgspec.MsgspecError, zmq.ZMQError) as error:
        raise RunError(
            f"{path} does not hold the run's keys ({error}): delete it to make new ones; workers "
            "that run now must then be started again"
        ) from None
    return replace(keys, path=path)


def write_keys(path: Path, keys: Keys) -> None:
    """Keep keys in a file that only the user may read."""
    write_whole(path, json.dumps(keys.content(), indent=1).encode(), PRIVATE)


def needs_keys(service: ServiceConfig) -> bool:
    """Whether who takes part must show a key, as on any address; ConfigError if ZeroMQ cannot."""
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

    Raises:
        TangramError: the folder of the sockets cannot be used.
    """
    if bind != LOCAL:
        return bind
    folder, found = Path(tempfile.gettempdir()) / f"tangram-{os.geteuid()}", run.stat()
    if not str(folder).isprintable():
        raise ConfigError(
            f"{os.fsencode(folder)!r} cannot hold sockets, whose paths are printable UTF-8: set "
            "TMPDIR to another folder, such as /tmp"
        )
    own_folder(folder)
    _sweep(folder)
    name = hashlib.sha256(f"{run.resolve()} {found.st_dev} {found.st_ino}".encode()).hexdigest()
    place = f"{folder}/{name[:12]}"
    if len(os.fsencode(f"{place}.episodes")) > MAX_SOCKET_PATH:
        raise ConfigError(
            f"{folder} is too long for sockets, whose paths have {MAX_SOCKET_PATH} bytes at most: "
            "set TMPDIR to a shorter one, such as /tmp"
        )
    return IPC + place


def _sweep(folder: Path) -> None:
    """Remove sockets that masters left which were killed and never came back."""
    for path in folder.iterdir():
        with suppress(OSError), socket.socket(socket.AF_UNIX) as end:
            if time.time() - path.stat().st_mtime < STALE_S:
                continue
            try:
                end.setblocking(False)
                end.connect(os.fspath(path))
            except ConnectionRefusedError:
                path.unlink()


class _Asked(ThreadAuthenticator):
    """Knows the address of whoever shows a key, which the callback is not told."""

    address = ""

    async def handle_zap_message(self, msg: list[bytes]) -> None:
        self.address = b"".join(msg[3:4]).decode(errors="replace")
        await super().handle_zap_message(msg)


class Authenticator:
    """Encrypts sockets of a context, and turns away those with another key than its file has."""

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        keys: Keys,
        counters: Counters,
        audit: Audit,
    ) -> None:
        self.keys, self._counters, self._audit = keys, counters, audit
        self._holders, self._former = holders(keys), dict[str, Holder]()
        self._stamp, self._look = self._stamped(), Every(LOOK_S)
        self._thread = _Asked(context)
        self._thread.start()
        self._thread.configure_curve_callback(domain=DOMAIN, credentials_provider=self)

    def guard(self, end: zmq.Socket[bytes]) -> None:
        """Encrypt a socket that is not bound yet."""
        end.setsockopt(zmq.CURVE_SERVER, 1)
        end.setsockopt(zmq.CURVE_SECRETKEY, self.keys.server.secret.encode())
        end.setsockopt_string(zmq.ZAP_DOMAIN, DOMAIN)

    def callback(self, _domain: str, key: bytes) -> bool:
        """Whether a key (Z85) may connect; called by the thread."""
        public = key.decode("ascii")
        allowed = public in self._holders
        if not allowed:
            former = self._former.get(public)
            self._counters.note("refused_keys", "a worker with the key of another run, or a former")
            reason = "no key of this run" if former is None else "revoked"
            name, address = "" if former is None else former.name, self._thread.address
            self._audit.note("refused", key=name, public=public, address=address, reason=reason)
        return allowed

    def holder(self, public: str) -> Holder:
        """Who has, or had, a key."""
        return self._holders.get(public) or self._former.get(public) or Holder(revoked=True)

    def revoked(self) -> list[Holder]:
        """Look at the file, once in a second, and return those whose keys are no longer there."""
        if not self._look.due() or (stamp := self._stamped()) in (None, self._stamp):
            return []
        self._stamp = stamp
        try:
            keys = read_keys(self.keys.path or Path())
        except RunError as error:
            log.warning("%s; those of before stay valid", error)
            return []
        self.keys, found = keys, holders(keys)
        gone = {key: one for key, one in self._holders.items() if key not in found}
        for key in found.keys() - self._holders.keys():
            log.info("the key '%s' may take part from now on", found[key].name)
        self._former |= {key: replace(one, revoked=True) for key, one in gone.items()}
        self._holders = found
        return list(gone.values())

    def close(self) -> None:
        """End the thread, before the context is destroyed."""
        self._thread.stop()

    def _stamped(self) -> tuple[int, int] | None:
        """What changes with the file; None where there is none."""
        with suppress(OSError):
            found = (self.keys.path or Path()).stat()
            return found.st_mtime_ns, found.st_ino
        return None
