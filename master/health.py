"""HTTP for machines: /metrics in Prometheus' format, and /healthz."""

import json
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST

from tangram_agent.messages import WORKER_COLUMNS, RunStatus
from tangram_sim.errors import ConfigError

OFF = -1
# A loop that has not come round for so long hangs; a checkpoint of a large replay takes seconds.
STALLED_S = 120.0
COUNTERS = "hub/"


class Health:
    """A small HTTP server in threads of its own.

    Attributes:
        url: where it listens.
    """

    def __init__(self, bind: str, port: int) -> None:
        """Listen.

        Args:
            bind: address.
            port: 0 for any free one.

        Raises:
            ConfigError: the address cannot be used.
        """
        self._status: RunStatus | None = None
        self._seen_s = time.monotonic()
        self._registry = CollectorRegistry()
        self._registry.register(self)
        try:
            self._server = _Server((bind, port), self)
        except OSError as error:
            raise ConfigError(
                f"cannot listen on {bind}, port {port} ({error.strerror}): choose another with "
                "service.http_bind and service.http_port, or service.http_port=-1 for none"
            ) from None
        host, found = self._server.server_address[:2]
        self.url = f"http://{host!s}:{found}"
        self._thread = Thread(target=self._server.serve_forever, name="health", daemon=True)
        self._thread.start()

    def update(self, status: RunStatus) -> None:
        """Show another status from now on."""
        self._status, self._seen_s = status, time.monotonic()

    def answer(self, path: str) -> tuple[int, str, bytes]:
        """Status, type and body of a page."""
        if path == "/metrics":
            return 200, CONTENT_TYPE_LATEST, generate_latest(self._registry)
        if path == "/healthz":
            code, content = self.health()
            return code, "application/json", json.dumps(content).encode() + b"\n"
        return 404, "text/plain", b"there are /metrics and /healthz\n"

    def health(self) -> tuple[int, dict[str, Any]]:
        """200 while the loop goes round, 503 when it hangs."""
        silent_s = time.monotonic() - self._seen_s
        ok = silent_s < STALLED_S
        texts = {} if self._status is None else dict(self._status.texts)
        state = "ok" if ok else f"the loop has hung for {silent_s:.0f} s"
        return (200 if ok else 503), {"status": state, **texts}

    def collect(self) -> Iterator[Metric]:
        """Prometheus' families of the last status."""
        status = self._status
        if status is None:
            return
        events = CounterMetricFamily("tangram_hub_events", "Messages by kind", labels=["event"])
        for name, value in status.numbers.items():
            if name.startswith(COUNTERS):
                events.add_metric([name.removeprefix(COUNTERS)], value)
            else:
                gauge = name.replace("/", "_")
                yield GaugeMetricFamily(f"tangram_{gauge}", f"See tangram-status: {name}", value)
        yield events
        for i, name in enumerate(WORKER_COLUMNS[3:], start=3):
            family = GaugeMetricFamily(
                f"tangram_worker_{name}", f"Of each worker: {name}", labels=["role", "index"]
            )
            for row in status.workers.tolist():
                role = "evaluator" if row[0] else "player"
                family.add_metric([role, str(int(row[1]))], row[i])
            yield family

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], health: Health) -> None:
        self.health = health
        super().__init__(address, _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = 10  # seconds that a client may take to ask

    def do_GET(self) -> None:  # the library's name
        code, kind, body = self.server.health.answer(self.path.partition("?")[0])
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Log nothing: a scraper asks every few seconds."""
