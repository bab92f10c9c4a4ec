"""Addresses of sockets, as those on other machines see them."""

import re
from ipaddress import IPv6Address

from tangram_sim.errors import ConfigError

LOCAL = "local"  # of service.bind: unix sockets instead of an address
IPC = "ipc://"
HOST = re.compile(r"[\w.*-]+")
WILDCARDS = ("0.0.0.0", "*", "[::]")  # noqa: S104  # replaced, never bound


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


def _split(address: str) -> tuple[str, str, str]:
    scheme, _, rest = address.partition("://")
    host, _, port = rest.rpartition(":")
    return scheme, host, port
