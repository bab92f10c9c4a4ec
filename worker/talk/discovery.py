"""Where the master is: an address, or the connection file that it writes into its run folder."""

import json
import re
import socket
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from zmq.utils import z85

from tangram_core.errors import UNREADABLE, RunError, UnavailableError
from tangram_core.run.outcome import FILE_NAME as RESULT
from tangram_core.store.files import check_own
from tangram_core.wire.addresses import IPC, dns_error

FILE_NAME = "connection.json"
# A master may still be starting, or wait in a queue.
PATIENCE_S = 60.0
LOOK_S = 0.2
SCHEME = "tcp://"
PLAIN_ADDRESS = re.compile(r"[\w.-]{1,249}:\d{1,5}|\[[0-9a-fA-F:.]+\]:\d+")  # without the scheme
KEY_BYTES = 32


@dataclass(frozen=True)
class MasterAddress:
    """Where a master listens, and what it takes to be let in.

    Attributes:
        endpoint: of its ROUTER socket.
        run_id: that it must have, empty where any will do.
        server_key: the master's public CURVE key, empty where nothing is encrypted.
        keys: role -> public and secret key, of those that may take part in it.
        settings: section -> those of the run; None where only an address is known.
    """

    endpoint: str
    run_id: str = ""
    server_key: str = ""
    keys: Mapping[str, tuple[str, str]] = field(default_factory=dict, repr=False)
    settings: Mapping[str, Any] | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.server_key or self.keys:
            _check_key("server_key", self.server_key)
            for role, (public, secret) in self.keys.items():
                _check_key(f"keys.{role}.public", public)
                _check_key(f"keys.{role}.secret", secret)
            if not self.keys:
                raise ValueError("it has a server_key, and no keys")
        if not isinstance(self.settings, Mapping | None):
            raise ValueError("settings must be a map")


def as_address(connect: str) -> str | None:
    """The address that `connect` names, as tcp://host:port; None where it names a file.

    host:port is an address unless a file here is called so.
    """
    if "://" in connect:
        return connect
    plain = PLAIN_ADDRESS.fullmatch(connect) and not Path(connect).exists()
    return f"{SCHEME}{connect}" if plain else None


def find_master(connect: str) -> MasterAddress | None:
    """The master's address; None while its file, or the folder of its sockets, is not there.

    `connect` is host:port with or without tcp://, a connection file, or a run folder with one.

    Raises:
        RunError: neither an address nor a readable connection file.
    """
    address = as_address(connect)
    if address is not None:
        return MasterAddress(_checked(address, connect))
    path = Path(connect)
    if path.is_dir():
        path /= FILE_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        endpoint, run_id = str(content["endpoint"]), str(content["run_id"])
        f"{endpoint}{run_id}".encode()  # half a character is no text
        if endpoint.startswith(f"{IPC}/"):
            _check_local(endpoint, str(content["machine"]), path)
        else:
            _checked(endpoint, str(path))
        found = content.get("keys", {}).items()
        keys = {str(role): (str(one["public"]), str(one["secret"])) for role, one in found}
        known = (endpoint, run_id, str(content.get("server_key", "")), keys)
        return MasterAddress(*known, content.get("settings"))
    except FileNotFoundError:
        return None
    except UNREADABLE as error:
        raise RunError(
            f"{path} is no connection file ({_why(error)}): connect=... takes host:port, a run "
            f"folder, or the {FILE_NAME} that tangram-master writes into it"
        ) from None


def await_master(
    connect: str, tell: Callable[[str], None], patience_s: float = PATIENCE_S
) -> MasterAddress:
    """The master's address, also when its file is written later; `tell` takes a line for the user.

    Raises:
        RunError: neither an address nor a readable connection file.
        UnavailableError: none in time.
    """
    until_s = time.monotonic() + patience_s
    told = False
    while (found := find_master(connect)) is None:
        if time.monotonic() >= until_s:
            raise UnavailableError(no_file_error(connect, patience_s))
        if not told:
            ended = (Path(connect) / RESULT).is_file()
            note = f"run {Path(connect).name} has ended, unless its master goes on with it: "
            wait = f"waits for the connection file {connect}, for {patience_s:g} s at most"
            tell(note * ended + wait)
            told = True
        time.sleep(LOOK_S)
    return found


def no_file_error(connect: str, patience_s: float) -> str:
    """The error that there is no connection file, for the user."""
    return (
        f"no connection file is at {connect} after {patience_s:g} s, or none whose sockets are "
        "there: is tangram-master running there?"
    )


def host_error(endpoint: str, connect: str) -> str:
    """What DNS says against the host of the master, for the user; empty where it knows it."""
    said = dns_error(endpoint)
    if not said or as_address(connect) is not None:
        return said and f"{said}: check the name in connect="
    return (
        f"{said}: it is the master's service.host and stands in {connect}; start the master with a "
        "name or an address that this machine knows"
    )


def keys_error(connect: str, endpoint: str) -> str:
    """The error that a handshake fails, for the user, with what `connect` names."""
    if as_address(connect) is not None:
        return (
            f"the master at {endpoint} wants keys, or is none: name its connection file instead, "
            f"connect=RUN_DIR/{FILE_NAME}, or one that tangram-keys made"
        )
    return (
        f"wrong or stale connection file: what answers at {endpoint} does not take the keys of "
        f"{connect}, of another run or revoked; take the file of a master that is running"
    )


def _why(error: Exception) -> str:
    """What is wrong with a file, for the user."""
    match error:
        case json.JSONDecodeError() | UnicodeDecodeError():
            return "it is not JSON"
        case RecursionError():
            return "it is nested too deeply"
        case KeyError():
            return f"it has no {error.args[0]}"
        case TypeError() | AttributeError():
            return "its content is another one"
    return str(getattr(error, "strerror", None) or error)


def _check_key(name: str, key: str) -> None:
    """Raise ValueError, without what may be a secret, for what ZeroMQ takes for no key."""
    try:
        whole = len(z85.decode(key)) == KEY_BYTES
    except (ValueError, KeyError, struct.error):
        whole = False
    if not whole:
        raise ValueError(f"{name} must be a key, 40 characters of Z85")


def _check_local(endpoint: str, machine: str, source: Path) -> None:
    """Look, and change nothing, whether only this user can listen there.

    Raises:
        RunError: the master listens on another machine, or perhaps another user does.
        FileNotFoundError: the folder is not there; another user could make it.
    """
    place = endpoint.removeprefix(IPC)
    if ".." in Path(place).parts:
        raise ValueError(f"its endpoint '{endpoint}' must be a path without '..'")
    if machine != socket.gethostname() and not Path(place).exists():
        raise RunError(
            f"{source}: this master listens on its own machine, {machine}, only: start it there "
            "with service.bind=0.0.0.0, or start this there"
        )
    check_own(Path(place).parent)


def _checked(endpoint: str, source: str) -> str:
    host, _, port = endpoint.removeprefix(SCHEME).rpartition(":")
    named = endpoint.startswith(SCHEME) and host.isprintable() and host.split() == [host]
    if not (named and port.isascii() and port.isdecimal() and 0 < int(port) < 65536):
        raise RunError(
            f"'{endpoint}' (from {source}) is no address: it must be tcp://host:port, the port "
            "from 1 to 65535"
        )
    return endpoint
