"""An HTTP server for monitoring: /metrics in the format of Prometheus, and /healthz."""

import json
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import SHUT_RDWR
from threading import Lock, Thread
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST

from tangram_core.errors import ConfigError
from tangram_core.run.process import Every
from tangram_core.wire.messages import WORKER_COLUMNS, RunStatus

OFF = -1
# Without a status for so long, the loop hangs; a checkpoint of a large replay takes seconds.
STALLED_S = 120.0
COUNTERS = "hub/"
MAX_OPEN = 64  # requests at the same time: each needs a thread and a descriptor
REQUEST_S = 10.0  # longest time from a client's connection to the end of the answer
TELL_S = 60.0

log = logging.getLogger(__name__)


class Health:
    """A small HTTP server in its own threads; port 0 means any free port.

    Attributes:
        url: address of the server.

    Raises:
        ConfigError: the address cannot be used.
    """

    def __init__(self, bind: str, port: int) -> None:
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
        """Set the status to show."""
        self._status, self._seen_s = status, time.monotonic()

    def answer(self, path: str) -> tuple[int, str, bytes]:
        """HTTP status code, content type and body for a path."""
        if path == "/metrics":
            return 200, CONTENT_TYPE_LATEST, generate_latest(self._registry)
        if path == "/healthz":
            code, content = self.health()
            return code, "application/json", json.dumps(content).encode() + b"\n"
        return 404, "text/plain", b"not found: use /metrics or /healthz\n"

    def health(self) -> tuple[int, dict[str, Any]]:
        """HTTP status code and content of /healthz: 200, or 503 if the loop hangs."""
        silent_s = time.monotonic() - self._seen_s
        ok = silent_s < STALLED_S
        texts = {} if self._status is None else dict(self._status.texts)
        state = "ok" if ok else f"the loop has hung for {silent_s:.0f} s"
        return (200 if ok else 503), {"status": state, **texts}

    def collect(self) -> Iterator[Metric]:
        """Yield the last status as metric families of Prometheus."""
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
    """Limits the number and duration of requests, and logs failures in one line per minute."""

    daemon_threads = True
    request_queue_size = MAX_OPEN

    def __init__(self, address: tuple[str, int], health: Health) -> None:
        self.health = health
        self._begun: dict[Any, float] = {}  # connection -> when it came
        self._lost, self._why, self._lock = 0, "", Lock()
        self._tell = Every(TELL_S, at_once=True)
        super().__init__(address, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if len(self._begun) >= MAX_OPEN:
            self._lose(client_address, f"{MAX_OPEN} others are open")
            self.shutdown_request(request)
            return
        self._begun[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self._begun.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """End slow requests and log failures; the library calls this twice a second."""
        latest_s = time.monotonic() - REQUEST_S
        for request, begun_s in list(self._begun.items()):
            if begun_s <= latest_s:
                with suppress(OSError):
                    request.shutdown(SHUT_RDWR)
        if self._lost and self._tell.due():
            with self._lock:
                lost, self._lost = self._lost, 0
            told = "HTTP requests without an answer: %d, the last one %s"
            log.warning(told, lost, self._why, extra={"event": "http", "lost": lost})

    def handle_error(self, _: Any, client_address: Any) -> None:
        """Count a failure instead of printing a traceback: most often a client has disconnected."""
        self._lose(client_address, repr(sys.exception()))

    def _lose(self, client_address: Any, why: str) -> None:
        with self._lock:
            self._lost, self._why = self._lost + 1, f"from {client_address[0]} ({why})"


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:  # the library's name
        code, kind, body = self.server.health.answer(self.path.partition("?")[0])
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Log nothing: a monitoring system asks every few seconds."""
