"""A real hub on real sockets, served from a thread: signals belong to the main thread."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

from master.arrivals import Arrival, WelcomeInfo
from master.hub import Hub
from tangram_agent.arrays import EpisodeSpec
from tangram_agent.setup import Setup

LIMIT_S = 60.0

Result = TypeVar("Result")


def open_hub(made: Setup, window: int = 4, seed: int = 11, lockstep: bool = False) -> Hub:
    """A master's hub on a free port."""
    spec = replace(EpisodeSpec.of(made), bound=100.0)
    info = WelcomeInfo("run", seed, made.fingerprints(), spec, window, lockstep)
    return Hub("127.0.0.1", 0, info)


def collect(hub: Hub, enough: Callable[[list[Arrival]], bool]) -> list[Arrival]:
    """Poll until there is enough."""
    arrivals: list[Arrival] = []
    deadline = time.monotonic() + LIMIT_S
    while not enough(arrivals):
        if time.monotonic() > deadline:
            raise TimeoutError(f"{len(arrivals)} arrivals, {dict(hub.counters)}")
        arrivals += hub.poll(0.05)
    return arrivals


def with_master(
    hub: Hub, script: Callable[[Hub], Result], worker: Callable[[], int]
) -> tuple[Result, int]:
    """Run a worker in this thread while the script serves the hub in another, then stop both."""

    def serve() -> Result:
        try:
            return script(hub)
        finally:
            hub.stop("the script is over")
            collect(hub, lambda _: not hub.peers)

    with hub, ThreadPoolExecutor(1) as pool:
        result = pool.submit(serve)
        status = worker()
        return result.result(LIMIT_S), status
