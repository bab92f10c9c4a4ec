"""Authentication of connections: CURVE encryption, its keys, and ZeroMQ's protocol ZAP.

A run has a pair of keys for the master, and one pair for each role, which the run's own workers
share. tangram-keys makes more keys for other users. All are valid as long as the run lasts, so that
a worker can reconnect after a restart of the master.
"""

import hashlib
import json
import logging
import os
import re
import struct
import tempfile
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
from tangram_core.store.files import PRIVATE, own_folder, write_whole
from tangram_core.wire.addresses import IPC, KEY_BYTES, LOCAL
from tangram_core.wire.messages import ROLES

DOMAIN = "tangram"
MAX_SOCKET_PATH = 107  # bytes, of Linux
NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,63}")  # of a key
LOOK_S = 1.0  # between two checks of the key file

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Pair:
    """A pair of CURVE keys, 40 characters of Z85 each; `repr` omits the secret one."""

    public: str
    secret: str = field(repr=False)


@dataclass(frozen=True)
class Given:
    """A key that tangram-keys made, with its role; only the user has the secret half."""

    role: str
    public: str


@dataclass(frozen=True)
class Keys:
    """The keys of a run.

    Attributes:
        server: key pair of the master.
        player, evaluator: key pairs of the run's own workers, by role.
        given: name -> key made by tangram-keys.
        path: file of the keys; the master reads it again when it changes.
    """

    server: Pair
    player: Pair
    evaluator: Pair
    given: Mapping[str, Given] = field(default_factory=dict)
    path: Path | None = field(default=None, compare=False)

    def own(self) -> dict[str, Pair]:
        """Role -> key pair of the run's own workers."""
        return {role: getattr(self, role) for role in ROLES}

    @property
    def names(self) -> set[str]:
        """The names of all keys of workers."""
        return {*ROLES, *self.given}

    def content(self) -> dict[str, Any]:
        """The content of the key file."""
        return {name: value for name, value in asdict(self).items() if name != "path"}


@dataclass(frozen=True)
class Holder:
    """The holder of a key.

    Attributes:
        name: of the key; empty if the run has no keys.
        role: role that the key allows; empty for any role if the run has no keys.
        revoked: whether the key is not valid any more.
    """

    name: str = ""
    role: str = ""
    revoked: bool = False


def make_pair() -> Pair:
    """Make a new key pair."""
    return Pair(*(key.decode("ascii") for key in zmq.curve_keypair()))


def make_keys() -> Keys:
    """Make the keys of a new run."""
    return Keys(make_pair(), make_pair(), make_pair())


def holders(keys: Keys) -> dict[str, Holder]:
    """Public key -> its holder."""
    own = {pair.public: Holder(role, role) for role, pair in keys.own().items()}
    return own | {one.public: Holder(name, one.role) for name, one in keys.given.items()}


def run_keys(path: Path) -> Keys:
    """Read the keys of a run, see `read_keys`; make and write them if there is no file."""
    if not path.exists():
        write_keys(path, make_keys())
    return read_keys(path)


def read_keys(path: Path) -> Keys:
    """Read and check a key file; RunError if its content is invalid."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        keys = msgspec.convert(content, Keys)
        if keys.content() != content:
            raise ValueError("it has unknown entries")
        for pair in (keys.server, *keys.own().values()):
            if zmq.curve_public(pair.secret.encode()).decode() != pair.public:
                raise ValueError("a public key does not match its secret key")
        for name, one in keys.given.items():
            if not NAME.fullmatch(name) or name in ROLES or one.role not in ROLES:
                raise ValueError(f"'{name}' is not a valid name, or its role is unknown")
            if len(z85.decode(one.public)) != KEY_BYTES:
                raise ValueError(f"the key of {name} has a wrong length")
    except (*UNREADABLE, struct.error, msgspec.MsgspecError, zmq.ZMQError) as error:
        raise RunError(
            f"{path} does not hold the run's keys ({error}): put a copy back, or delete the file, "
            "start master and workers again, and make other keys anew"
        ) from None
    return replace(keys, path=path)


def write_keys(path: Path, keys: Keys) -> None:
    """Write keys to a file that only the user can read."""
    write_whole(path, json.dumps(keys.content(), indent=1).encode(), PRIVATE)


def needs_keys(service: ServiceConfig) -> bool:
    """Whether the settings ask for keys; ConfigError if ZeroMQ was built without encryption."""
    wanted = service.bind != LOCAL and service.auth == "on"
    if wanted and not zmq.has("curve"):
        raise ConfigError(
            "this ZeroMQ was built without CURVE: install pyzmq from its wheel, or leave "
            f"service.bind at {LOCAL}"
        )
    return wanted


def listening_place(bind: str, run: Path) -> str:
    """The address to listen on; for unix sockets, `ipc://` and the first part of their paths.

    Unix sockets are in a folder in TMPDIR that only this user can enter. The run folder may be on a
    shared file system, or its path may be too long. After a restart a run has the same paths.

    Raises:
        TangramError: the folder of the sockets cannot be used.
    """
    if bind != LOCAL:
        return bind
    folder, found = Path(tempfile.gettempdir()) / f"tangram-{os.geteuid()}", run.stat()
    if not str(folder).isprintable():
        raise ConfigError(
            f"{os.fsencode(folder)!r} cannot hold sockets, as their paths must be printable UTF-8: "
            "set TMPDIR to another folder, such as /tmp"
        )
    own_folder(folder)
    name = hashlib.sha256(f"{run.resolve()} {found.st_dev} {found.st_ino}".encode()).hexdigest()
    place = f"{folder}/{name[:12]}"
    if len(os.fsencode(f"{place}.episodes")) > MAX_SOCKET_PATH:
        raise ConfigError(
            f"{folder} is too long: paths of sockets have at most {MAX_SOCKET_PATH} bytes: set "
            "TMPDIR to a shorter path, such as /tmp"
        )
    return IPC + place


class _Asked(ThreadAuthenticator):
    """Stores the network address of the client, since the callback does not get it."""

    address = ""

    async def handle_zap_message(self, msg: list[bytes]) -> None:
        self.address = b"".join(msg[3:4]).decode(errors="replace")
        await super().handle_zap_message(msg)


class Authenticator:
    """Encrypts the sockets of a context, and rejects clients whose key is not in the key file.

    Attributes:
        keys: as last read from their file.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        keys: Keys,
        counters: Counters,
        audit: Audit,
    ) -> None:
        self.keys, self._counters, self._audit = keys, counters, audit
        self._holders, self._former = holders(keys), dict[str, Holder]()
        # The first look reads the file again: it may have changed since it was read.
        self._stamp: tuple[int, int] | None = None
        self._look = Every(LOOK_S)
        self._thread = _Asked(context)
        self._thread.start()
        self._thread.configure_curve_callback(domain=DOMAIN, credentials_provider=self)

    def guard(self, end: zmq.Socket[bytes]) -> None:
        """Encrypt a socket; call this before the socket is bound."""
        end.setsockopt(zmq.CURVE_SERVER, 1)
        end.setsockopt(zmq.CURVE_SECRETKEY, self.keys.server.secret.encode())
        end.setsockopt_string(zmq.ZAP_DOMAIN, DOMAIN)

    def callback(self, _domain: str, key: bytes) -> bool:
        """Whether a public key (Z85) may connect; ZeroMQ's authentication thread calls this."""
        public = key.decode("ascii")
        allowed = public in self._holders
        if not allowed:
            former = self._former.get(public)
            self._counters.note("refused_keys", "a worker has a revoked key or one of another run")
            reason = "no key of this run" if former is None else "revoked"
            name, address = "" if former is None else former.name, self._thread.address
            self._audit.note("refused", key=name, public=public, address=address, reason=reason)
        return allowed

    def holder(self, public: str) -> Holder:
        """The holder of a public key, also of a revoked one."""
        return self._holders.get(public) or self._former.get(public) or Holder(revoked=True)

    def revoked(self) -> list[Holder]:
        """Read the key file again if it changed, and return the holders of the removed keys.

        The file is checked once in `LOOK_S` at most. If it is invalid, the old keys stay valid.
        """
        if not self._look.due() or (stamp := self._stamped()) in (None, self._stamp):
            return []
        try:
            keys = read_keys(self.keys.path or Path())
        except RunError as error:
            self._counters.note("unread_keys", f"{error}; until then the old keys stay valid")
            return []
        self.keys, self._stamp, found = keys, stamp, holders(keys)
        gone = {key: one for key, one in self._holders.items() if key not in found}
        for key in found.keys() - self._holders.keys():
            log.info("the key '%s' may take part from now on", found[key].name)
        self._former |= {key: replace(one, revoked=True) for key, one in gone.items()}
        self._holders = found
        return list(gone.values())

    def close(self) -> None:
        """End the thread; call this before the context is destroyed."""
        self._thread.stop()

    def _stamped(self) -> tuple[int, int] | None:
        """Time and number of the key file, to detect changes; None if there is no file."""
        with suppress(OSError):
            found = (self.keys.path or Path()).stat()
            return found.st_ctime_ns, found.st_ino
        return None
