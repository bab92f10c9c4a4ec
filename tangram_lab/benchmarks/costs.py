"""What a message costs the master beyond learning, in the CPU time of its one loop."""

import secrets
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from master.delivery import EpisodesArrived
from master.hub import Hub
from master.journal import Journal
from master.registry import Registry
from master.trainer import Trainer
from tangram_agent.messages import Hello
from tangram_lab.benchmarks.measure import Row, single
from tangram_lab.benchmarks.setups import played, preset
from tangram_lab.benchmarks.wire import UNIX, Case, connected

STAGE, UNIT = "scaling", "us of CPU"
BATCH, MESSAGES = 32, 500
PEERS = (100, 1000)
POLLS = 200
CASE = Case("1 token, 32 in a batch, unix", 1, BATCH, UNIX)


class Spent:
    """CPU time of this thread by what it went into."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def on(self, name: str) -> Iterator[None]:
        """Add the CPU time of what is done inside."""
        begin = time.thread_time()
        try:
            yield
        finally:
            self.seconds[name] += time.thread_time() - begin


def measure_costs(runs: int) -> list[Row]:
    """Rows without targets: the parts of a message's way, and the peers that say nothing."""
    return [*_messages(runs), *_peers(runs)]


def _messages(runs: int) -> Iterator[Row]:
    setup = preset()
    trainer = Trainer(setup, 0, "cpu")
    with tempfile.TemporaryDirectory(prefix="tangram-") as folder:
        journal = Journal(Path(folder), "bench", setup.task_digest(), 1.0)
        with (
            closing(journal),
            connected(CASE, setup, played(setup, BATCH)) as hub,
        ):
            found = [_parts(hub, journal, trainer) for _ in range(runs + 1)][1:]
    for name in found[0]:
        yield single((STAGE, f"a message of {BATCH} episodes: {name}", UNIT), _us(found, name))


def _parts(hub: Hub, journal: Journal, trainer: Trainer) -> dict[str, float]:
    """Seconds of each part for one message, as the loop goes through them."""
    spent, count = Spent(), 0
    while count < MESSAGES:
        with spent.on("receive, decode, check"):
            arrivals = hub.poll(1.0)
        for arrival in arrivals:
            assert isinstance(arrival, EpisodesArrived)
            with spent.on("journal"):
                journal.append(arrival)
            with spent.on("insert and relabel"):
                trainer.insert(arrival.episodes)
            with spent.on("acknowledge"):
                hub.acknowledge(arrival)
            count += 1
    parts = {name: seconds / count for name, seconds in spent.seconds.items()}
    return {**parts, "all": sum(parts.values())}


def _us(found: list[dict[str, float]], name: str) -> list[float]:
    return [parts[name] * 1e6 for parts in found]


def _peers(runs: int) -> Iterator[Row]:
    """What peers cost that say nothing just now: they are looked through for silent ones."""
    for count in PEERS:
        registry = _registry(count)

        def look(registry: Registry = registry) -> None:
            registry.drop_silent(time.monotonic(), 3600.0)

        values = [_time(look) * 1e6 for _ in range(runs)]
        yield single((STAGE, f"a look for silent ones among {count} workers", UNIT), values)


def _registry(count: int) -> Registry:
    registry = Registry({}, 30.0)
    for index in range(count):
        hello = Hello("player", index, 0, secrets.token_hex(16), 1, {}, "")
        registry.admit(secrets.token_bytes(17), hello, time.monotonic())
    return registry


def _time(work: Callable[[], None]) -> float:
    """CPU seconds of one call."""
    begin = time.thread_time()
    for _ in range(POLLS):
        work()
    return (time.thread_time() - begin) / POLLS
