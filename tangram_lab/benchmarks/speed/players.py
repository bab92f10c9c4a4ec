"""Synthetic players: many real Clients in one process, which send what was played before."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

from tangram_agent.setup import Setup
from tangram_core.spec import Episodes
from worker.talk.client import Client

PAUSE_S = 0.002  # between two rounds over all clients, or as long as a round took


@dataclass
class Ages:
    """How old the weights are that a batch would have been played with.

    The age counts from when the first of all players had these weights, which is a round after the
    master sent them at most.

    Attributes:
        path: to which a line is added for each batch: monotonic time, age in seconds.
        first: version -> when the first player had it.
        held: player -> version that it holds.
    """

    path: Path
    first: dict[int, float] = field(default_factory=dict)
    held: dict[int, int] = field(default_factory=dict)
    _lines: list[str] = field(default_factory=list)

    def look(self, player: int, client: Client) -> None:
        """Take the newest weights."""
        weights = client.newest_weights()
        if weights is not None:
            self.held[player] = weights.version
            self.first.setdefault(weights.version, time.monotonic())

    def sent(self, player: int) -> None:
        """Note the age of what the player holds."""
        now = time.monotonic()
        self._lines.append(f"{now} {now - self.first[self.held[player]]}\n")

    def write(self) -> None:
        """Add what was noted to the file."""
        if self._lines:
            with self.path.open("a") as file:
                file.writelines(self._lines)
            self._lines.clear()


def read_ages(path: Path, begin: float, end: float) -> list[float]:
    """Ages of the batches that were sent in a stretch of monotonic time."""
    rows = [tuple(map(float, line.split())) for line in path.read_text().splitlines()]
    return [age for at, age in rows if begin <= at <= end]


@contextmanager
def players(
    connect: Path, setup: Setup, episodes: Episodes, count: int, ages: Path
) -> Iterator[int]:
    """So many players in a process of their own; its id. It is ended at the end."""
    arguments = (str(connect), setup, episodes, count, ages)
    process = get_context("spawn").Process(target=play, args=arguments, daemon=True)
    process.start()
    assert process.pid is not None
    try:
        yield process.pid
    finally:
        process.kill()
        process.join()


def play(connect: str, setup: Setup, episodes: Episodes, count: int, path: Path) -> None:
    """Let all players send whatever their windows take, until the master sends them home."""
    spec, ages = setup.spec, Ages(path)
    with ExitStack() as stack:
        clients = [
            stack.enter_context(Client(connect, "player", i, setup.fingerprints(), spec))
            for i in range(count)
        ]
        while not all(client.stopped for client in clients):
            begin = time.monotonic()
            for player, client in enumerate(clients):
                _step(player, client, episodes, ages)
            ages.write()
            # Many share few cores with the master: they leave it half of one.
            time.sleep(max(PAUSE_S, time.monotonic() - begin))


def _step(player: int, client: Client, episodes: Episodes, ages: Ages) -> None:
    client.poll()
    ages.look(player, client)
    version = ages.held.get(player)
    if version is not None and client.window_free and not client.stopped:
        ages.sent(player)
        client.send(episodes, version)
