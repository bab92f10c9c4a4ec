"""Addresses of sockets for processes on this and on other machines."""

import re
import socket
from ipaddress import IPv6Address
from threading import Thread

from tangram_core.errors import ConfigError

DNS_S = 2.0  # longest wait for an answer
LOCAL = "local"  # value of service.bind: unix sockets instead of an address
IPC, TCP = "ipc://", "tcp://"
KEY_BYTES = 32
HOST = re.compile(r"[\w.*-]+")
WILDCARDS = ("0.0.0.0", "*", "[::]")  # noqa: S104  # replaced, never bound
# TCP keepalive finds dead connections. Pings of ZMTP can end the process that sends them: if a
# connection is reset while its queue is full, an assertion of ZeroMQ fails
# (https://github.com/zeromq/libzmq/issues/4364).
DEAD_S, PROBE_S = 30, 5
KEEPALIVE = {  # options of ZeroMQ
    "TCP_KEEPALIVE": 1,
    "TCP_KEEPALIVE_IDLE": PROBE_S,
    "TCP_KEEPALIVE_INTVL": PROBE_S,
    "TCP_KEEPALIVE_CNT": DEAD_S // PROBE_S - 1,
    "TCP_MAXRT": DEAD_S * 1000,  # for data that is sent
}


def check_host(name: str, host: str) -> None:
    """Raise ConfigError unless a setting is a host without scheme and port."""
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
    """The host of scheme://host:port; an IPv6 address is in brackets."""
    return _split(address)[1]


def reachable(address: str, host: str) -> str:
    """The address, with `host` in place of a wildcard such as 0.0.0.0."""
    return with_host(address, host) if host_of(address) in WILDCARDS else address


def with_host(address: str, host: str) -> str:
    """The address with another host; an IPv6 address gets brackets."""
    scheme, _, port = _split(address)
    bracketed = f"[{host}]" if ":" in host and not host.startswith("[") else host
    return f"{scheme}://{bracketed}:{port}"


def dns_error(endpoint: str, patience_s: float = DNS_S) -> str:
    """The reason why DNS finds no address for a host, for the user; empty if it finds one."""
    if endpoint.startswith(IPC):
        return ""
    host, said = host_of(endpoint).strip("[]"), [f"no answer in {patience_s:g} s"]

    def resolve() -> None:
        try:
            socket.getaddrinfo(host, None)
            said[0] = ""
        except (OSError, UnicodeError) as error:
            said[0] = str(getattr(error, "strerror", None) or error)

    # In a thread: a name server that does not answer blocks for half a minute.
    asking = Thread(target=resolve, daemon=True)
    asking.start()
    asking.join(patience_s)
    return f"DNS knows no host '{host}' ({said[0]})" if said[0] else ""


def _split(address: str) -> tuple[str, str, str]:
    scheme, _, rest = address.partition("://")
    host, _, port = rest.rpartition(":")
    return scheme, host, port
