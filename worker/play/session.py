"""Code that player and evaluator share: join a master, end on a signal, write log lines."""

import logging
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

import torch

from tangram_core.agent import Actor, Weights
from tangram_core.errors import TangramError
from tangram_core.run.process import (
    WATCHDOG_S,
    Watchdog,
    formatter,
    handling,
    keep_memory,
    watch_parent,
)
from tangram_core.setup import Setup
from tangram_core.wire.arrays import check_batch_size
from tangram_core.wire.messages import TAKEN_OVER
from worker.config import WorkerConfig
from worker.talk.client import Client

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
REPORT_S = 30.0

_log = logging.getLogger(__name__)


class Acting:
    """An actor and the version of its weights, -1 before any were loaded."""

    def __init__(self, actor: Actor) -> None:
        self.actor, self.version = actor, -1

    def follow(self, weights: Weights) -> None:
        """Load broadcast weights; RunError if they belong to another network."""
        self.actor.load(weights.tensors)
        self.version = weights.version


class IndexTakenError(TangramError):
    """The index that the master chose for this process was taken by another process."""


@contextmanager
def joined(config: WorkerConfig, setup: Setup, actor: Actor) -> Iterator[Client]:
    """A client that has joined the master, or that was stopped before it could.

    On exit the client says goodbye to the master, after all queued batches, and the former signal
    handlers are restored.

    Raises:
        TangramError: the master refuses or does not answer.
        IndexTakenError: another process took the index that the master chose for this one.
    """
    watch_parent()
    # Several workers share one machine, so more threads in each would only slow all of them.
    torch.set_num_threads(1)
    keep_memory()
    service = config.service
    log_as(config.role, service.log_format)
    spec = setup.spec
    check_batch_size(spec)
    watchdog = Watchdog(WATCHDOG_S)
    client = Client(
        config.connect,
        config.role,
        config.index,
        setup.fingerprints(),
        spec,
        actor.shapes,
    )
    client.on_progress = watchdog.progress
    # Signals stop the client, not the process, so that the client can say BYE.
    with client, handling(lambda number: client.stop(number.name), SIGNALS), watchdog:
        if client.join():
            me = client.welcome
            log_as(f"{config.role} {me.index}", service.log_format)
            fields = {"event": "joined", "run_id": me.run_id, "incarnation": me.incarnation}
            _log.info("joined run %s", me.run_id, extra=fields)
        yield client
        if config.index < 0 and TAKEN_OVER in client.stop_reason:
            raise IndexTakenError(client.stop_reason)
        _log.info("ends: %s", client.stop_reason, extra={"event": "ended"})


def keep_part(run: Callable[[WorkerConfig, Setup], int], config: WorkerConfig, setup: Setup) -> int:
    """Run a player or an evaluator, and run it again whenever another process takes its index.

    Returns the exit status of `run`; errors of `run` other than IndexTakenError pass through.
    """
    while True:
        try:
            return run(config, setup)
        except IndexTakenError as error:
            fields = {"event": "index_taken"}
            _log.info("%s: this process joins again, with a free index", error, extra=fields)


def log_as(who: str, log_format: str) -> None:
    """Send the log lines of this process to stderr, each with the time and the name `who`."""
    logger = logging.getLogger("worker")
    logger.setLevel(logging.INFO)
    for former in [h for h in logger.handlers if isinstance(h, _Lines)]:
        logger.removeHandler(former)
    handler = _Lines(sys.stderr)
    handler.setFormatter(formatter(log_format, who))
    logger.addHandler(handler)


class _Lines(logging.StreamHandler[TextIO]):
    """The log handler of `log_as`, a class of its own so that a second call can replace it."""


class Report:
    """Log lines of a player: reasons for waiting, and its speed every REPORT_S seconds."""

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        processor: Callable[[], float] = time.process_time,
    ) -> None:
        self._clock, self._processor = clock, processor
        self._begun_s, self._total = processor(), 0
        self._begin()

    def _begin(self) -> None:
        self._since = self._clock()
        self._episodes = 0
        self._waited = 0.0
        self._told: set[str] = set()

    @contextmanager
    def waiting(self, why: str) -> Iterator[None]:
        """Count the time in this context as waiting; log each reason once between two reports."""
        if why not in self._told:
            _log.info("waits: %s", why, extra={"event": "waits"})
            self._told.add(why)
        start = self._clock()
        try:
            yield
        finally:
            self._waited += self._clock() - start

    def played(self, episodes: int, version: int) -> dict[str, float]:
        """Count episodes played with weights of `version`, and log the speed when it is due.

        Returns:
            "episodes" and "busy_s": episodes and CPU seconds since the start.
        """
        self._episodes += episodes
        self._total += episodes
        totals = {"episodes": float(self._total), "busy_s": self._processor() - self._begun_s}
        passed = self._clock() - self._since
        if passed < REPORT_S:
            return totals
        values = {
            "episodes": self._episodes,
            "seconds": passed,
            "episodes_per_s": self._episodes / passed,
            "percent_waiting": 100.0 * self._waited / passed,
            "weights_version": version,
        }
        _log.info(
            "%d episodes in %.0f s (%.1f/s), %.0f %% of the time waiting, weights %d",
            *values.values(),
            extra={"event": "played", **values},
        )
        self._begin()
        return totals
