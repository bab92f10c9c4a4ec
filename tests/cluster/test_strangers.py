"""What those may cost who have no key, or too much to say; a real master, and workers meanwhile."""

import json
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from master.gate import Room
from tangram_agent.arrays import MAX_FRAME_BYTES
from tangram_lab.benchmarks.strangers import Strangers, subscribe
from tests.cluster.players import (
    TCP,
    Player,
    finish,
    master,
    more_acknowledged,
    players,
    setup_of,
    until,
)

pytestmark = pytest.mark.cluster
KEYS = ("service.bind=127.0.0.1",)
# 16 where there is little else to do; without bounds 30 of them cost 940, a topic 1,700.
MOST_MIB = 64


class Trained:
    """A real master with a player whose batches are acknowledged."""

    def __init__(
        self, process: "subprocess.Popen[bytes]", folder: Path, made: list[Player]
    ) -> None:
        self.process, self.players, self._proc = process, made, Path(f"/proc/{process.pid}")
        self.where = json.loads((folder / "connection.json").read_text())

    def resident(self) -> float:
        """MiB of the master."""
        lines = (self._proc / "status").read_text().splitlines()
        return sum(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024

    def files(self) -> int:
        """That the master has open."""
        return sum(1 for _ in (self._proc / "fd").iterdir())

    def storm(self, strangers: Strangers, count: int, look: Callable[[], float]) -> float:
        """Let so many be turned away; the most that was seen meanwhile."""
        seen = list[float]()

        def step() -> bool:
            strangers.push()
            seen.append(look())
            return strangers.ended >= count

        until(self.players, step)
        return max(seen)


@contextmanager
def trained(folder: Path, *more: str, files: int | None = None) -> Iterator[Trained]:
    with ExitStack() as opened:
        process = opened.enter_context(master(folder, *more, files=files))
        made = opened.enter_context(players(setup_of(folder), folder))
        more_acknowledged(made, 20)
        yield Trained(process, folder, made)
        more_acknowledged(made, 5)
        finish(made, process)


def test_1000_who_send_all_they_can_cost_little_memory(folder: Path) -> None:
    """They come again whenever they are ended. A worker that joins gets in between them."""
    with (
        trained(folder, *KEYS) as run,
        Strangers(run.where["endpoint"], 1000, MAX_FRAME_BYTES) as strangers,
    ):
        before, most = run.resident(), run.storm(strangers, 1000, run.resident)
        told, late = run.players[0].acknowledged, Player(folder, 1, setup_of(folder))
        with late.client:
            run.players.append(late)
            more = run.storm(strangers, 3000, run.resident)
            more_acknowledged(run.players, 3)
            most = max(most, more)
            run.players.pop()
        assert run.players[0].acknowledged > told
        print(f"{before:.0f} MiB, then at most {most:.0f}; {strangers.ended} were ended")
        assert most - before <= MOST_MIB


@pytest.mark.check
def test_3300_who_say_nothing_take_no_descriptors(folder: Path) -> None:
    Room.here()  # this process needs some, too
    with (
        trained(folder, *KEYS, files=1024) as run,
        Strangers(run.where["endpoint"], 3300) as strangers,
    ):
        before, most = run.files(), run.storm(strangers, 3300, run.files)
        print(f"{before} files, then at most {most}; {strangers.ended} were ended")
        assert most < 1000
        more_acknowledged(run.players, 20)


@pytest.mark.check
def test_a_topic_of_16_mib_costs_nothing(folder: Path) -> None:
    with trained(folder, *TCP) as run:
        before = run.resident()
        assert not subscribe(run.where["weights_endpoint"], 16 * 2**20)
        assert run.resident() - before <= MOST_MIB
