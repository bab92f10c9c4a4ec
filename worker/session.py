"""What player and evaluator share: joining a master, ending on a signal, and log lines."""

import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TextIO

import torch

from tangram_agent import lifeline
from tangram_agent.arrays import EpisodeSpec
from tangram_agent.logs import formatter
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.watchdog import Watchdog
from worker.config import WorkerConfig
from worker.link import Link

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2)

_log = logging.getLogger(__name__)


@contextmanager
def joined(config: WorkerConfig, setup: Setup, policy: Policy) -> Iterator[Link]:
    """A link to the master that has joined, or that was stopped while it tried.

    On leaving, the master is told, after the batches that are on their way, and the signal handlers
    are put back.

    Args:
        config: of this worker.
        setup: the task, which the master must share.
        policy: what the master's weights must fit.

    Raises:
        ConfigError: service.batch_episodes makes messages that are too large.
        TangramError: the master refuses, or does not answer.
    """
    lifeline.watch()
    # Several workers share one machine: more threads each would only get in each other's way.
    torch.set_num_threads(1)
    service = config.service
    log_as(config.role, service.log_format)
    spec = EpisodeSpec.of(setup)
    if config.role == "player":
        spec.check_batch_size(service.batch_episodes)
    watchdog = Watchdog(service.watchdog_seconds)
    link = Link(
        config.connect,
        config.role,
        config.index,
        setup.fingerprints(),
        spec,
        policy.shapes,
        service.window,
    )
    link.on_progress = watchdog.progress
    with link, stopped_by_signals(link), watchdog:
        _log.info("joining %s", config.connect, extra={"event": "joining"})
        if link.join():
            me = link.welcome
            log_as(f"{config.role} {me.index}", service.log_format)
            fields = {"event": "joined", "run_id": me.run_id, "incarnation": me.incarnation}
            _log.info("joined run %s", me.run_id, extra=fields)
        yield link
        _log.info("ends: %s", link.stop_reason, extra={"event": "ended"})


@contextmanager
def stopped_by_signals(link: Link) -> Iterator[None]:
    """The signals stop the link instead of the process, so that it can say BYE."""

    def handle(number: int, _frame: FrameType | None) -> None:
        link.stop(signal.Signals(number).name)

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def log_as(who: str, log_format: str) -> None:
    """Log lines of this room go to stderr, with the time and who writes them."""
    logger = logging.getLogger("worker")
    logger.setLevel(logging.INFO)
    for former in [h for h in logger.handlers if isinstance(h, _Lines)]:
        logger.removeHandler(former)
    handler = _Lines(sys.stderr)
    handler.setFormatter(formatter(log_format, who))
    logger.addHandler(handler)


class _Lines(logging.StreamHandler[TextIO]):
    """The handler that `log_as` replaces."""
