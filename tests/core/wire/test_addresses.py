"""Addresses as others see them."""

import pytest

from tangram_core.errors import ConfigError
from tangram_core.wire.addresses import check_host, host_of, reachable, with_host

pytestmark = pytest.mark.fast


@pytest.mark.parametrize(
    ("address", "host", "seen"),
    [
        ("tcp://10.0.0.1:5", "learner", "tcp://10.0.0.1:5"),
        ("tcp://0.0.0.0:5", "learner", "tcp://learner:5"),
        ("http://0.0.0.0:5", "learner", "http://learner:5"),
        ("tcp://*:5", "learner", "tcp://learner:5"),
        ("tcp://[::]:5", "[fe80::1]", "tcp://[fe80::1]:5"),
        ("tcp://[::]:5", "fe80::1", "tcp://[fe80::1]:5"),
    ],
)
def test_a_wildcard_becomes_a_host(address: str, host: str, seen: str) -> None:
    assert reachable(address, host) == seen


@pytest.mark.parametrize("host", ["", " ", "a b", "10.0.0.1:5", "tcp://a", "[a]"])
def test_what_is_no_host_alone_is_refused(host: str) -> None:
    with pytest.raises(ConfigError, match="^service.bind must be an address or a name .* got '"):
        check_host("service.bind", host)


@pytest.mark.parametrize("host", ["10.0.0.1", "[fe80::1]", "a.b"])
def test_hosts(host: str) -> None:
    check_host("service.host", host)
    address = f"tcp://{host}:5"
    assert host_of(address) == host
    assert with_host(address, "x") == "tcp://x:5"
    assert with_host(address, host) == address
