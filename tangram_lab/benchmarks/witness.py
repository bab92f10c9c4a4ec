"""A player of a real run that remembers every episode it sent, and what was acknowledged."""

from collections import Counter
from contextlib import closing
from pathlib import Path
from threading import Event, Thread

import numpy as np

from tangram_agent.arrays import EpisodeSpec
from tangram_agent.checkpoints import list_checkpoints, load_checkpoint
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_sim.batch import BatchedEnv
from tangram_sim.errors import TangramError
from worker.client import Client
from worker.rollout import Rollout

ENVS = 4
WINDOW = 4
INDEX = 1000


class Witness(Thread):
    """Plays until it is asked to stop, or sent home.

    Attributes:
        setup: of the run.
        sent: episodes by batch, each known by its first state and action.
        acknowledged: number of the last batch up to which all were acknowledged.
        error: what ended it, if that was a failure.
    """

    def __init__(self, connect: str, setup: Setup) -> None:
        super().__init__(name="witness", daemon=True)
        self.sent: list[list[bytes]] = []
        self.acknowledged = 0
        self.error: TangramError | None = None
        self.setup = setup
        self._connect, self._ends = connect, Event()

    def stop(self) -> None:
        """Ask it to stop."""
        self._ends.set()

    def run(self) -> None:
        """Play."""
        try:
            self._play()
        except TangramError as error:
            self.error = error

    def _play(self) -> None:
        setup, policy = self.setup, Policy(self.setup)
        client = Client(
            self._connect,
            "player",
            INDEX,
            setup.fingerprints(),
            EpisodeSpec.of(setup),
            policy.shapes,
            WINDOW,
        )
        with closing(BatchedEnv(setup.layout, setup.sim, setup.reward, ENVS)) as env, client:
            client.on_progress = lambda: self._look(client)
            if not client.join():
                return
            first = client.wait_for_weights()
            if first is None:
                return
            policy.load(first)
            me = client.welcome
            rollout = Rollout(env, me.seed, "witness", me.index, me.incarnation)
            while client.wait_for_window():
                newest = client.newest_weights()
                if newest is not None:
                    policy.load(newest)
                episodes = rollout.play(policy.explore)
                self.sent.append(keys(episodes.corners[:, 0], episodes.actions[:, 0]))
                if not client.send(episodes, policy.version):
                    self.sent.pop()
            self._look(client)

    def _look(self, client: Client) -> None:
        self.acknowledged = client.acknowledged
        if self._ends.is_set():
            client.stop("the trial is over")


def keys(states: np.ndarray, actions: np.ndarray) -> list[bytes]:
    """Each episode by its first state and action, which no other one shares."""
    return [
        s.astype("<f4").tobytes() + a.astype("<f4").tobytes()
        for s, a in zip(states, actions, strict=True)
    ]


def compare(folder: Path, witness: Witness) -> dict[str, int]:
    """What the last checkpoint of a run has of what a witness sent.

    The replay must be large enough to hold the whole run. Each episode of one action stands there
    also relabelled, with the same state and action.
    """
    replay = load_checkpoint(list_checkpoints(folder / "checkpoints")[-1]).arrays["replay"]
    found = keys(replay["state"], replay["action"])
    counts = Counter(found)
    copies = 1 + sum(one.copies for one in witness.setup.agent.hindsight)
    acknowledged = [key for batch in witness.sent[: witness.acknowledged] for key in batch]
    every = [key for batch in witness.sent for key in batch]
    return {
        "sent": len(every),
        "acknowledged": len(acknowledged),
        "lost": sum(counts[key] < copies for key in acknowledged),
        "doubled": sum(counts[key] > copies for key in every),
        "unacknowledged_but_there": sum(counts[k] > 0 for k in every[len(acknowledged) :]),
    }
