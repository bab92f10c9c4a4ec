"""What the hub is told when it opens, and what it hands on to the loop."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tangram_agent.arrays import EpisodeSpec
from tangram_agent.messages import EpisodeBatch, Scores
from tangram_agent.types import Episodes


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
    """A new batch that waits for its insert; its arrays are read-only.

    Attributes:
        role, index, incarnation: of its sender.
        batch: as it was read.
        frames: as they came, for the journal.
    """

    role: str
    index: int
    incarnation: int
    batch: EpisodeBatch
    frames: Sequence[bytes]

    @property
    def sequence(self) -> int:
        """Number of the batch."""
        return self.batch.sequence

    @property
    def weights_version(self) -> int:
        """Of the weights that played it."""
        return self.batch.weights_version

    @property
    def episodes(self) -> Episodes:
        """What was played."""
        return self.batch.episodes


@dataclass(frozen=True, eq=False)
class ScoresArrived:
    """Results of an evaluator."""

    index: int
    incarnation: int
    scores: Scores


Arrival = EpisodesArrived | ScoresArrived
