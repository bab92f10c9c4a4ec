"""What those may cost who have no key, or too much to say; a real master, and workers meanwhile."""

import json
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tangram_agent.arrays import MAX_FRAME_BYTES
from tangram_lab.benchmarks.strangers import Strangers
from tests.cluster.players import (
    Player,
    finish,
    master,
    more_acknowledged,
    players,
    setup_of,
    until,
)

pytestmark = pytest.mark.cluster
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

    def storm(self, strangers: Strangers, count: int) -> float:
        """Let so many be turned away; the most memory that was seen meanwhile."""
        seen = list[float]()

        def step() -> bool:
            strangers.push()
            seen.append(self.resident())
            return strangers.ended >= count

        until(self.players, step)
        return max(seen)


@contextmanager
def trained(folder: Path) -> Iterator[Trained]:
    with ExitStack() as opened:
        process = opened.enter_context(master(folder, "service.bind=127.0.0.1"))
        made = opened.enter_context(players(setup_of(folder), folder))
        more_acknowledged(made, 20)
        yield Trained(process, folder, made)
        more_acknowledged(made, 5)
        finish(made, process)


def test_1000_who_send_all_they_can_cost_little_memory(folder: Path) -> None:
    """They come again whenever they are ended. A worker that joins gets in between them."""
    with (
        trained(folder) as run,
        Strangers(run.where["endpoint"], 1000, MAX_FRAME_BYTES) as strangers,
    ):
        before, most = run.resident(), run.storm(strangers, 1000)
        told, late = run.players[0].acknowledged, Player(folder, 1, setup_of(folder))
        with late.client:
            run.players.append(late)
            more = run.storm(strangers, 3000)
            more_acknowledged(run.players, 3)
            most = max(most, more)
            run.players.pop()
        assert run.players[0].acknowledged > told
        print(f"{before:.0f} MiB, then at most {most:.0f}; {strangers.ended} were ended")
        assert most - before <= MOST_MIB
