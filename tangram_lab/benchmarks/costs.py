"""What a message costs the master beyond learning, in the CPU time of its one loop."""

import secrets
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import zmq

from master.delivery import EpisodesArrived
from master.hub import Hub
from master.journal import Journal
from master.registry import Registry
from master.security import Keys, make_keys
from master.trainer import Trainer
from tangram_agent.messages import Hello
from tangram_agent.types import Weights
from tangram_lab.benchmarks.measure import Row, single
from tangram_lab.benchmarks.setups import played, preset
from tangram_lab.benchmarks.wire import CURVE, PLAIN, UNIX, Case, connected, opened

STAGE, UNIT = "scaling", "us of CPU"
BATCH, MESSAGES = 32, 500
PEERS = (100, 1000)
SUBSCRIBERS, BROADCASTS = 100, 10  # few would find each other's bytes in the cache
PATIENCE_MS = 20_000
IO_THREAD = "(ZMQbg/IO/"
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
    return [*_messages(runs), *_broadcasts(runs), *_peers(runs)]


def _broadcasts(runs: int) -> Iterator[Row]:
    """What ZeroMQ's own thread takes to send weights, for each megabyte to each worker."""
    for way in (UNIX, PLAIN, CURVE):
        with _heard(way) as send:
            found = [send() for _ in range(runs + 1)][1:]
        yield single((STAGE, f"weights to workers, {way}", "us of CPU for each MB"), found)


@contextmanager
def _heard(way: str) -> Iterator[Callable[[], float]]:
    """Sends the default agent's weights to all subscribers; the us for a megabyte to one."""
    setup, keys = preset(), make_keys() if way == CURVE else None
    others = _io_threads()
    with ExitStack() as stack:
        hub, _ = stack.enter_context(opened(way, setup, keys))
        while not (mine := _io_threads() - others):  # a thread names itself when it runs
            time.sleep(0.01)
        (thread,) = mine
        context = stack.enter_context(zmq.Context())
        ends = []
        for _ in range(SUBSCRIBERS):  # one by one, since strangers are limited
            ends.append(stack.enter_context(_subscriber(context, hub.weights_endpoint, keys)))
            while not ends[-1].poll(10):
                hub.publish(Weights(0, {}))
        weights = Trainer(setup, 0, "cpu").weights()

        def send() -> float:
            for end in ends:
                while end.poll(100):
                    end.recv()
            begin, size = _cpu_s(thread), 0
            for _ in range(BROADCASTS):
                hub.publish(weights)
                size += sum(len(end.recv()) for end in ends)
            return (_cpu_s(thread) - begin) / size * 1e12

        yield send


def _subscriber(
    context: "zmq.Context[zmq.Socket[bytes]]", endpoint: str, keys: Keys | None
) -> "zmq.Socket[bytes]":
    end = context.socket(zmq.SUB)
    end.setsockopt(zmq.RCVTIMEO, PATIENCE_MS)
    end.setsockopt(zmq.SUBSCRIBE, b"")
    if keys is not None:
        end.setsockopt(zmq.CURVE_SERVERKEY, keys.server.public.encode())
        end.setsockopt(zmq.CURVE_PUBLICKEY, keys.player.public.encode())
        end.setsockopt(zmq.CURVE_SECRETKEY, keys.player.secret.encode())
    end.connect(endpoint)
    return end


def _io_threads() -> set[Path]:
    """Of ZeroMQ in this process."""
    tasks = Path("/proc/self/task").iterdir()
    return {task for task in tasks if IO_THREAD in (task / "stat").read_text()}


def _cpu_s(thread: Path) -> float:
    return int((thread / "schedstat").read_text().split()[0]) / 1e9


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
