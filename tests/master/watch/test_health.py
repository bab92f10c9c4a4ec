"""HTTP for machines: what Prometheus and a health check see."""

import json
import re
import socket
import struct
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from functools import partial

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from master.watch import health as health_module
from master.watch.health import Health
from tangram_core.errors import ConfigError, is_passing
from tangram_core.wire.messages import WORKER_COLUMNS, RunStatus

pytestmark = pytest.mark.cluster

STATUS = RunStatus(
    {"updates": 7.0, "share": -1.0, "test/mean_reward": 0.5, "hub/batches": 2.0},
    {"run": "r", "activity": "learning"},
    np.array([[0, 3, 1, 0.5, 8, 10, 320, 320, 2], [1, 0, 2, 1.5, -1, 0, 0, 0, 0]], np.float64),
)


@pytest.fixture
def health() -> Iterator[Health]:
    with closing(Health("127.0.0.1", 0)) as made:
        yield made


def fetch(url: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(url, timeout=10) as answer:  # noqa: S310
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def samples(text: str) -> dict[tuple[str, ...], float]:
    return {
        (sample.name, *map(sample.labels.get, sorted(sample.labels, reverse=True))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_metrics_are_those_of_the_last_status(health: Health) -> None:
    assert fetch(f"{health.url}/metrics") == (200, "")
    health.update(STATUS)
    code, text = fetch(f"{health.url}/metrics")
    found = samples(text)
    assert code == 200
    assert (
        found.items()
        >= {
            ("tangram_updates",): 7.0,
            ("tangram_share",): -1.0,
            ("tangram_test_mean_reward",): 0.5,
            ("tangram_hub_events_total", "batches"): 2.0,
            ("tangram_worker_behind", "player", "3"): 8.0,
            ("tangram_worker_silent_s", "evaluator", "0"): 1.5,
        }.items()
    )
    per_worker = [name for name in found if name[0].startswith("tangram_worker_")]
    assert len(per_worker) == 2 * (len(WORKER_COLUMNS) - 3)
    assert fetch(f"{health.url}/etc/passwd")[0] == 404


@pytest.mark.parametrize(
    ("stalled_s", "code", "status"), [(60.0, 200, "ok"), (0.0, 503, "the loop has hung for 0 s")]
)
def test_health_is_lost_when_the_loop_hangs(
    health: Health, monkeypatch: pytest.MonkeyPatch, stalled_s: float, code: int, status: str
) -> None:
    monkeypatch.setattr(health_module, "STALLED_S", stalled_s)
    health.update(STATUS)
    found, text = fetch(f"{health.url}/healthz")
    assert found == code
    assert json.loads(text)["status"].startswith(status)
    assert json.loads(text)["activity"] == "learning"


def wait_until(done: Callable[[], bool], limit_s: float = 10.0) -> None:
    until_s = time.monotonic() + limit_s
    while not done():
        assert time.monotonic() < until_s, "it does not come"
        time.sleep(0.02)


def port_of(health: Health) -> int:
    return int(health.url.rpartition(":")[2])


def test_who_takes_too_long_to_ask_is_hung_up_on(
    health: Health, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that sends a byte every now and then, which no timeout of a socket ends."""
    monkeypatch.setattr(health_module, "REQUEST_S", 1.0)
    with socket.create_connection(("127.0.0.1", port_of(health)), timeout=0.2) as slow:
        began_s, heard = time.monotonic(), b"?"
        while heard and time.monotonic() - began_s < 10.0:
            with suppress(TimeoutError, ConnectionError):
                slow.sendall(b"G")
                heard = slow.recv(1)
    assert heard == b""


def test_requests_at_once_are_bounded(health: Health, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health_module, "MAX_OPEN", 3)
    with ExitStack() as opened:
        connect = partial(socket.create_connection, ("127.0.0.1", port_of(health)), timeout=10)
        held = [opened.enter_context(connect()) for _ in range(3)]
        for _ in range(3):
            assert opened.enter_context(connect()).recv(1) == b""
        for one in held:
            one.sendall(b"GET /healthz HTTP/1.0\r\n\r\n")
            assert one.recv(12) == b"HTTP/1.0 200"

    def is_served() -> bool:
        try:
            return fetch(f"{health.url}/healthz")[0] == 200
        except OSError:
            return False  # those before have had their answer, and are not gone yet

    wait_until(is_served)


def test_requests_that_are_reset_are_one_line(
    health: Health, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    for _ in range(20):
        with socket.create_connection(("127.0.0.1", port_of(health)), timeout=10) as client:
            client.sendall(b"GET /met")
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    told = re.compile(
        r"HTTP requests without an answer: (\d+), the last one from 127\.0\.0\.1 "
        r"\(ConnectionResetError\(104, 'Connection reset by peer'\)\)"
    )
    wait_until(lambda: bool(caplog.messages))
    [line] = caplog.messages
    said = told.fullmatch(line)
    assert said
    wait_until(lambda: int(said[1]) + health._server._lost == 20)  # of the next line, in a minute
    assert capfd.readouterr().err == ""


def test_a_port_that_is_taken_is_told(health: Health) -> None:
    port = port_of(health)
    with pytest.raises(
        ConfigError, match=rf"port {port} \(.*service\.http_port=-1 for none"
    ) as told:
        Health("127.0.0.1", port)
    assert is_passing(told.value)
