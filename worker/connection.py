"""Where the master is: an address, or the connection file that it writes into its run folder."""

import json
from dataclasses import dataclass
from pathlib import Path

from tangram_sim.errors import RunError

FILE_NAME = "connection.json"
SCHEME = "tcp://"
WILDCARDS = ("0.0.0.0", "*", "[::]")  # noqa: S104  # replaced, never bound


@dataclass(frozen=True)
class Connection:
    """An address of a master.

    Attributes:
        endpoint: of its ROUTER socket.
        run_id: that it must have, empty where any will do.
    """

    endpoint: str
    run_id: str = ""


def find_connection(connect: str) -> Connection | None:
    """The master's address; None while its file is not there.

    Args:
        connect: tcp://host:port, a connection file, or a run folder that holds one.

    Raises:
        RunError: neither an address nor a readable connection file.
    """
    if "://" in connect:
        return Connection(_checked(connect, connect))
    path = Path(connect)
    if path.is_dir():
        path /= FILE_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return Connection(_checked(str(content["endpoint"]), str(path)), str(content["run_id"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(
            f"{path} is no connection file ({error!r}): connect=... takes tcp://host:port, a run "
            f"folder, or the {FILE_NAME} that tangram-master writes into it"
        ) from None


def reachable(endpoint: str, via: str) -> str:
    """An endpoint as seen from here: a wildcard host becomes the host of the endpoint `via`."""
    host, _, port = endpoint.removeprefix(SCHEME).rpartition(":")
    if host not in WILDCARDS:
        return endpoint
    own_host = via.removeprefix(SCHEME).rpartition(":")[0]
    return f"{SCHEME}{own_host}:{port}"


def _checked(endpoint: str, source: str) -> str:
    host, _, port = endpoint.removeprefix(SCHEME).rpartition(":")
    if not (endpoint.startswith(SCHEME) and host and port.isdecimal() and 0 < int(port) < 65536):
        raise RunError(f"'{endpoint}' (from {source}) is no address: it must be tcp://host:port")
    return endpoint
