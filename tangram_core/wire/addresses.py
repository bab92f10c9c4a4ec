"""Addresses of sockets, as those on other machines see them."""

import re
import socket
from ipaddress import IPv6Address
from threading import Thread

from tangram_core.errors import ConfigError

DNS_S = 2.0  # to wait for its answer
LOCAL = "local"  # of service.bind: unix sockets instead of an address
IPC = "ipc://"
HOST = re.compile(r"[\w.*-]+")
WILDCARDS = ("0.0.0.0", "*", "[::]")  # noqa: S104  # replaced, never bound
# TCP finds connections that died without a word. ZMTP's own pings end the process that sends them:
# for one that has been reset while its queue was full, an assertion of ZeroMQ's fails
# (https://github.com/zeromq/libzmq/issues/4364).
DEAD_S, PROBE_S = 30, 5
KEEPALIVE = {  # options of ZeroMQ
    "TCP_KEEPALIVE": 1,
    "TCP_KEEPALIVE_IDLE": PROBE_S,
    "TCP_KEEPALIVE_INTVL": PROBE_S,
    "TCP_KEEPALIVE_CNT": DEAD_S // PROBE_S - 1,
    "TCP_MAXRT": DEAD_S * 1000,  # of what is sent
}


def check_host(name: str, host: str) -> None:
    """Raise ConfigError for a setting that is no host alone, without scheme and port."""
    try:
        if ":" in host:
            IPv6Address(host.removeprefix("[").removesuffix("]"))
        elif not HOST.fullmatch(host):
            raise ValueError
    except ValueError:
        raise ConfigError(
            f"{name} must be an address or a name of a machine, without scheme and port, got "
            f"'{host}': set {name}=127.0.0.1"
        ) from None


def host_of(address: str) -> str:
    """The host of scheme://host:port; IPv6 in brackets."""
    return _split(address)[1]


def reachable(address: str, host: str) -> str:
    """The address, whose host becomes this one if it stands for all of a machine's addresses."""
    return with_host(address, host) if host_of(address) in WILDCARDS else address


def with_host(address: str, host: str) -> str:
    """The address with another host; a plain IPv6 address gets its brackets."""
    scheme, _, port = _split(address)
    bracketed = f"[{host}]" if ":" in host and not host.startswith("[") else host
    return f"{scheme}://{bracketed}:{port}"


def dns_error(endpoint: str, patience_s: float = DNS_S) -> str:
    """What DNS says against the host of an address, for the user; empty where it has an address."""
    if endpoint.startswith(IPC):
        return ""
    host, said = host_of(endpoint).strip("[]"), [f"no answer in {patience_s:g} s"]

    def resolve() -> None:
        try:
            socket.getaddrinfo(host, None)
            said[0] = ""
        except (OSError, UnicodeError) as error:
            said[0] = str(getattr(error, "strerror", None) or error)

    # In a thread of its own: a name server that is away holds a process for half a minute.
    asking = Thread(target=resolve, daemon=True)
    asking.start()
    asking.join(patience_s)
    return f"DNS knows no host '{host}' ({said[0]})" if said[0] else ""


def _split(address: str) -> tuple[str, str, str]:
    scheme, _, rest = address.partition("://")
    host, _, port = rest.rpartition(":")
    return scheme, host, port
