"""What the hub is told when it opens, and what it hands on to the loop."""

from collections.abc import Mapping
from dataclasses import dataclass

from tangram_agent.payloads import EpisodeSpec
from tangram_agent.types import Episodes
from tangram_agent.wire import Scores


@dataclass(frozen=True)
class WelcomeInfo:
    """What the master tells, and asks of, a process that joins.

    Attributes:
        run_id: of the run.
        seed: of the run.
        fingerprints: section of the settings -> digest; a worker's must be equal.
        spec: the task that arrays are checked against.
        window: most unacknowledged batches of one peer.
        lockstep: players wait for orders.
    """

    run_id: str
    seed: int
    fingerprints: Mapping[str, str]
    spec: EpisodeSpec
    window: int = 4
    lockstep: bool = False


@dataclass(frozen=True, eq=False)
class EpisodesArrived:
    """A new batch that waits for its insert; its arrays are read-only."""

    role: str
    index: int
    incarnation: int
    sequence: int
    weights_version: int
    episodes: Episodes


@dataclass(frozen=True, eq=False)
class ScoresArrived:
    """Results of an evaluator."""

    index: int
    incarnation: int
    scores: Scores


Arrival = EpisodesArrived | ScoresArrived
