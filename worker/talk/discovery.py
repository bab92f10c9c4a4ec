"""How to find a master: by its address, or by the connection file in its run folder."""

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
from tangram_core.wire.addresses import IPC, KEY_BYTES, TCP, dns_error

FILE_NAME = "connection.json"
# The master may still be starting, or waiting in the queue of a cluster.
PATIENCE_S = 60.0
LOOK_S = 0.2
PLAIN_ADDRESS = re.compile(r"[\w.-]{1,249}:\d{1,5}|\[[0-9a-fA-F:.]+\]:\d+")  # without the scheme


@dataclass(frozen=True)
class MasterAddress:
    """Address of a master, and the keys to authenticate with.

    Attributes:
        endpoint: ZeroMQ address of the master's ROUTER socket.
        run_id: expected id of the run; empty accepts any.
        server_key: the master's public CURVE key; empty without encryption.
        keys: role -> public and secret key of a worker in this role.
        settings: section -> settings of the run; None if only an address is known.
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
                raise ValueError("it has a server_key but no keys")
        if not isinstance(self.settings, Mapping | None):
            raise ValueError("settings must be a map")


def as_address(connect: str) -> str | None:
    """The address in `connect`, as tcp://host:port; None if `connect` names a file.

    host:port is an address unless a file of this name exists.
    """
    if "://" in connect:
        return connect
    plain = PLAIN_ADDRESS.fullmatch(connect) and not Path(connect).exists()
    return f"{TCP}{connect}" if plain else None


def find_master(connect: str) -> MasterAddress | None:
    """The master's address; None while the connection file or the folder of sockets is missing.

    `connect` is host:port with or without tcp://, a connection file, or a run folder with one.

    Raises:
        RunError: `connect` is neither an address nor a readable connection file.
    """
    address = as_address(connect)
    if address is not None:
        return MasterAddress(_checked(address, connect))
    path = Path(connect)
    try:
        if path.is_dir():
            path /= FILE_NAME
        content = json.loads(path.read_text(encoding="utf-8"))
        endpoint, run_id = str(content["endpoint"]), str(content["run_id"])
        f"{endpoint}{run_id}".encode()  # raises UnicodeEncodeError for a lone surrogate
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
            f"{path} is no connection file ({_why(error)}): set connect=... to host:port, a run "
            f"folder, or the {FILE_NAME} that tangram-master writes into it"
        ) from None


def await_master(
    connect: str, tell: Callable[[str], None], patience_s: float = PATIENCE_S
) -> MasterAddress:
    """Wait for the connection file and return the master's address; `tell` prints a line.

    Raises:
        RunError: `connect` is neither an address nor a readable connection file.
        UnavailableError: no connection file after `patience_s` seconds.
    """
    until_s = time.monotonic() + patience_s
    told = False
    while (found := find_master(connect)) is None:
        if time.monotonic() >= until_s:
            raise UnavailableError(no_file_error(connect, patience_s))
        if not told:
            ended = (Path(connect) / RESULT).is_file()
            note = f"run {Path(connect).name} has ended, unless its master resumes it: "
            wait = f"waits at most {patience_s:g} s for the connection file {connect}"
            tell(note * ended + wait)
            told = True
        time.sleep(LOOK_S)
    return found


def no_file_error(connect: str, patience_s: float) -> str:
    """Error message: there is no connection file."""
    return (
        f"no connection file is at {connect} after {patience_s:g} s, or its sockets do not exist: "
        "is tangram-master running there?"
    )


def host_error(endpoint: str, connect: str) -> str:
    """Error message: DNS does not know the master's host; empty if the host is known."""
    said = dns_error(endpoint)
    if not said or as_address(connect) is not None:
        return said and f"{said}: check the name in connect="
    return (
        f"{said}: {connect} has this name from its master; start it with service.host= a name or "
        "an address that this machine knows"
    )


def keys_error(connect: str, endpoint: str) -> str:
    """Error message: the handshake failed; its remedy depends on what `connect` names."""
    if as_address(connect) is not None:
        return (
            f"the master at {endpoint} wants keys, or is no master: set connect to its connection "
            f"file, connect=RUN_DIR/{FILE_NAME}, or to one that tangram-keys made"
        )
    return (
        f"wrong or stale connection file: the master at {endpoint} refuses the keys in {connect}, "
        "which are of another run or revoked, or it has no connection free; use the file of a "
        "master that is running"
    )


def _why(error: Exception) -> str:
    """What is wrong with a connection file, in words for the user."""
    match error:
        case json.JSONDecodeError() | UnicodeDecodeError():
            return "it is not JSON"
        case RecursionError():
            return "it is nested too deeply"
        case KeyError():
            return f"it has no {error.args[0]}"
        case TypeError() | AttributeError():
            return "its values have the wrong types"
    return str(getattr(error, "strerror", None) or error)


def _check_key(name: str, key: str) -> None:
    """Raise ValueError unless `key` is a CURVE key; the message hides it, it may be secret."""
    try:
        whole = len(z85.decode(key)) == KEY_BYTES
    except (ValueError, KeyError, struct.error):
        whole = False
    if not whole:
        raise ValueError(f"{name} must be a key, 40 characters of Z85")


def _check_local(endpoint: str, machine: str, source: Path) -> None:
    """Check, without changing anything, that only this user can listen at a local socket.

    Raises:
        RunError: the master is on another machine, or another user may own the socket.
        FileNotFoundError: the folder of the socket is missing, so any user could create it.
    """
    place = endpoint.removeprefix(IPC)
    if ".." in Path(place).parts:
        raise ValueError(f"its endpoint '{endpoint}' must be a path without '..'")
    if machine != socket.gethostname() and not Path(place).exists():
        raise RunError(
            f"{source}: this master listens only on its own machine, {machine}: start the master "
            f"with service.bind=0.0.0.0, or start this command on {machine}"
        )
    check_own(Path(place).parent)


def _checked(endpoint: str, source: str) -> str:
    host, _, port = endpoint.removeprefix(TCP).rpartition(":")
    named = endpoint.startswith(TCP) and host.isprintable() and host.split() == [host]
    if not (
        named and len(port) < 6 and port.isascii() and port.isdecimal() and 0 < int(port) < 65536
    ):
        raise RunError(
            f"'{endpoint}' (from {source}) is no address: it must be tcp://host:port, with a port "
            "from 1 to 65535"
        )
    return endpoint
