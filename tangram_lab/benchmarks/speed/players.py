"""Synthetic players: many real Clients in one process, which send ready-made episodes."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from pathlib import Path

from tangram_core.setup import Setup
from tangram_core.spec import Episodes
from worker.talk.client import Client

PAUSE_S = 0.002  # shortest pause between two rounds over all clients


@contextmanager
def players(connect: Path, setup: Setup, episodes: Episodes, count: int) -> Iterator[int]:
    """Run `count` players in one process inside this context; yield the id of the process."""
    arguments = (str(connect), setup, episodes, count)
    process = get_context("spawn").Process(target=play, args=arguments, daemon=True)
    process.start()
    assert process.pid is not None
    try:
        yield process.pid
    finally:
        process.kill()
        process.join()


def play(connect: str, setup: Setup, episodes: Episodes, count: int) -> None:
    """Send `episodes` from all players whenever there is room, until the master stops them."""
    spec, versions = setup.spec, dict[int, int]()
    with ExitStack() as stack:
        clients = [
            stack.enter_context(Client(connect, "player", i, setup.fingerprints(), spec))
            for i in range(count)
        ]
        while not all(client.stopped for client in clients):
            begun_s = time.process_time()  # without the time in which a benchmark stops the process
            for player, client in enumerate(clients):
                client.poll()
                weights = client.newest_weights()
                if weights is not None:
                    versions[player] = weights.version
                if player in versions and client.window_free and not client.stopped:
                    client.send(episodes, versions[player])
            # The players share few cores with the master, so they rest half of the time.
            time.sleep(max(PAUSE_S, time.process_time() - begun_s))
