"""What those may cost who have no key, or too much to say; a real master, and workers meanwhile."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tangram_agent.arrays import MAX_FRAME_BYTES
from tangram_lab.benchmarks.strangers import Strangers
from tests.cluster.players import finish, master, more_acknowledged, players, setup_of, until

pytestmark = pytest.mark.cluster
KEYS = ("service.bind=127.0.0.1",)
MIB = 2**20


def resident(pid: int) -> float:
    """MiB of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    [kib] = [int(line.split()[1]) for line in lines if line.startswith("VmRSS:")]
    return kib / 1024


def test_1000_who_send_what_they_can_cost_little_memory(folder: Path) -> None:
    """They come again when they are ended. A worker that joins gets in between them."""
    with master(folder, *KEYS) as process:
        where = json.loads((folder / "connection.json").read_text())
        setup = setup_of(folder)
        with (
            players(setup, folder) as made,
            Strangers(where["endpoint"], 1000, MAX_FRAME_BYTES) as strangers,
        ):
            more_acknowledged(made, 20)
            before, sizes = resident(process.pid), list[float]()

            def stormed(count: int) -> Callable[[], bool]:
                def step() -> bool:
                    strangers.push()
                    sizes.append(resident(process.pid))
                    return strangers.ended >= count

                return step

            until(made, stormed(1000))
            storm = made[0].acknowledged
            until(made, stormed(3000))
            assert made[0].acknowledged > storm
            print(f"{before:.0f} MiB, at most {max(sizes):.0f}", made[0].acknowledged - storm)
            assert max(sizes) - before <= 64
            more_acknowledged(made, 5)
            finish(made, process)
