"""Workers of a real master that know what they sent, and what must be in its replay."""

import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tangram_core.setup import Setup, make_setup
from tangram_core.spec import Episodes
from tangram_core.store.checkpoints import list_checkpoints, load_checkpoint
from tests.agent.builders import random_episodes
from tests.agent.no_reward import NOTHING
from tests.cluster.processes import LIMIT_S, started, wait_for_file
from worker.talk.client import Client
from worker.talk.connection import Timing

EPISODES = 3  # in each batch
FIRST_TAG = 2.0  # rewards of hindsight twins are 0
QUICK = Timing(retry_s=0.2, heartbeat_s=0.2, resend_s=1.0, silence_s=1.5)
PATIENT = replace(QUICK, silence_s=30.0)  # a master on a busy machine may be silent for seconds
MASTER = (
    "resume=auto",
    "sim=kinematic",
    "net=mlp",
    "agent.updates_per_transition=0.02",
    "agent.learning_starts=30",
    "agent.batch_size=16",
    "agent.replay_capacity=2000000",  # nothing makes room for anything
    f"reward.name={NOTHING}",
)
TCP = ("service.bind=127.0.0.1", "service.auth=off")  # for those who know its address alone


@contextmanager
def master(folder: Path, *more: str) -> Iterator["subprocess.Popen[bytes]"]:
    """A real master that can be reached."""
    (folder / "connection.json").unlink(missing_ok=True)
    settings = f"run_dir={folder}", *MASTER, *more
    with started("tangram-master", *settings, cwd=folder) as process:
        wait_for_file(folder / "connection.json", process)
        yield process


class Player:
    """A worker whose batches can be told apart in the replay, by their rewards."""

    def __init__(
        self,
        connect: str | Path,
        index: int,
        setup: Setup,
        tag_index: int | None = None,
        timing: Timing = QUICK,
    ) -> None:
        self._setup, self.index = setup, index
        self._first_tag = FIRST_TAG + 100_000.0 * (index if tag_index is None else tag_index)
        spec = setup.spec
        self.client = Client(
            str(connect), "player", index, setup.fingerprints(), spec, None, 4, timing
        )
        self.sent = 0

    @property
    def acknowledged(self) -> int:
        return self.client.acknowledged

    def tag(self, sequence: int) -> float:
        return self._first_tag + sequence

    def assert_exactly_once(self, found: Mapping[float, int]) -> int:
        """All that was acknowledged was found, once, and nothing that was not sent.

        Args:
            found: tag -> episodes.

        Returns:
            Batches that were found.
        """
        own = {tag: n for tag, n in found.items() if 0 < tag - self._first_tag < 100_000}
        acknowledged = {self.tag(n): EPISODES for n in range(1, self.acknowledged + 1)}
        sent = {self.tag(n): EPISODES for n in range(1, self.sent + 1)}
        assert acknowledged.items() <= own.items() <= sent.items()
        return len(own)

    def step(self) -> None:
        """Send what the window takes, and take what came."""
        while self.client.joined and self.client.window_free and not self.client.stopped:
            self.sent += 1
            episodes = random_episodes(self._setup, EPISODES, seed=self.sent)
            tags = np.full_like(episodes.rewards, self.tag(self.sent))
            assert self.client.send(Episodes({**episodes.arrays, "rewards": tags}), -1)
        self.client.poll(0.002)


def until(players: list[Player], done: Callable[[], Any]) -> None:
    """Play until something holds."""
    end = time.monotonic() + LIMIT_S
    while not done():
        assert time.monotonic() < end, [player.acknowledged for player in players]
        for player in players:
            player.step()
        if not players:
            time.sleep(0.02)  # whoever is waited for needs the processor


def finish(players: list[Player], process: "subprocess.Popen[bytes]") -> None:
    """End the master in order, with the players at work."""
    process.terminate()
    until(players, lambda: process.poll() is not None)
    assert process.returncode == 0


def more_acknowledged(players: list[Player], batches: int) -> None:
    """Play until each has so many more acknowledgements."""
    wanted = [player.acknowledged + batches for player in players]
    until(players, lambda: all(p.acknowledged >= w for p, w in zip(players, wanted, strict=True)))


def later_acknowledged(players: list[Player]) -> None:
    """Play until each has an acknowledgement of a batch that it has not sent yet."""
    sent = [player.sent for player in players]
    until(players, lambda: all(p.acknowledged > n for p, n in zip(players, sent, strict=True)))


def setup_of(folder: Path) -> Setup:
    return make_setup(yaml.safe_load((folder / "config.yaml").read_text()))


@contextmanager
def players(
    setup: Setup, *connects: str | Path, beside: str | Path | None = None
) -> Iterator[list[Player]]:
    """Players that have joined; the last one, `beside`, must not notice what befalls the others."""
    with ExitStack() as stack:
        made = [Player(connect, i, setup) for i, connect in enumerate(connects)]
        if beside is not None:
            made.append(Player(beside, len(made), setup, timing=PATIENT))
        for player in made:
            stack.enter_context(player.client)
            assert player.client.join()
        yield made


def tags_in_replay(folder: Path) -> dict[float, int]:
    """Tag -> episodes in the replay of the last checkpoint."""
    content = load_checkpoint(list_checkpoints(folder / "checkpoints")[-1])
    tags, counts = np.unique(content.arrays["replay"]["reward"], return_counts=True)
    found = dict(zip(tags.tolist(), counts.tolist(), strict=True))
    return {tag: count for tag, count in found.items() if tag >= FIRST_TAG}


def assert_exactly_once(folder: Path, players: list[Player]) -> None:
    """The last checkpoint against what the players know."""
    found = tags_in_replay(folder)
    batches = [player.assert_exactly_once(found) for player in players]
    assert sum(batches) == len(found)
    counters = load_checkpoint(list_checkpoints(folder / "checkpoints")[-1]).counters
    assert counters["episodes"] == sum(found.values())  # nobody else played
    table = counters["hub"]
    for player, count in zip(players, batches, strict=True):
        assert table[f"player/{player.index}"]["sequence"] == count
