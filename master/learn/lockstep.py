"""Lockstep: learner and players wait for each other, so the same seed gives the same weights.

A run is a sequence of rounds. In a round each of N players plays one batch with the same weights.
The random generators of an episode depend only on (run, role, index, number). The master inserts
the batches in the order of the index, makes all updates that are due, and sends the weights for the
next round. So speed and restarts of processes have no effect on the result. The number of inserted
episodes determines the round, so a resumed run continues in the right one.
"""

from master.record.delivery import EpisodesArrived
from tangram_core.run.service import ServiceConfig
from tangram_core.spec import EpisodeSpec
from tangram_core.wire.arrays import check_batch_size
from tangram_core.wire.messages import Go


class Lockstep:
    """The rounds of a run; in each, every player 0 to N - 1 plays `batch_episodes` episodes.

    Attributes:
        ordered: whether the orders of this round were sent.
    """

    def __init__(self, players: int, batch_episodes: int) -> None:
        self._players, self._size = players, batch_episodes
        self._arrived: dict[int, EpisodesArrived] = {}
        self.ordered = False

    @staticmethod
    def of(service: ServiceConfig, workers: int, spec: EpisodeSpec) -> "Lockstep | None":
        """Create the lockstep of a run; None in any other mode.

        Raises:
            ConfigError: a batch is too large for one message.
        """
        if service.mode != "lockstep":
            return None
        size = service.batch_episodes(spec.horizon)
        check_batch_size(spec, size)
        return Lockstep(workers, size)

    def begins_round(self, episodes: int) -> bool:
        """Whether a round begins after `episodes` inserted episodes."""
        return episodes // self._size % self._players == 0

    def orders(self, version: int, episodes: int) -> dict[int, Go]:
        """Index -> order to play with weights `version`, after `episodes` inserted episodes."""
        number, done = divmod(episodes // self._size, self._players)
        first = number * self._size
        return {i: Go(number, version, first, self._size) for i in range(done, self._players)}

    def take(self, arrival: EpisodesArrived) -> None:
        """Store an ordered batch; the players' batches may arrive in any order."""
        self._arrived[arrival.index] = arrival

    def next(self, episodes: int) -> EpisodesArrived | None:
        """The batch to insert after `episodes` episodes; None until the round is complete."""
        index = episodes // self._size % self._players
        if not all(i in self._arrived for i in range(index, self._players)):
            return None
        return self._arrived[index]

    def inserted(self, arrival: EpisodesArrived) -> None:
        """Note that a batch was inserted; the last one of a round ends the round."""
        del self._arrived[arrival.index]
        if not self._arrived:
            self.ordered = False
