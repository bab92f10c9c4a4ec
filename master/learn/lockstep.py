"""Lockstep: everybody waits for everybody, so that the same seed gives the same weights.

A run is a row of rounds. In a round each of N players plays one batch with the same weights, and
episodes whose generators follow from (run, role, index, number) alone; the master inserts the
batches by index, makes all updates that are due, and sends the weights that the next round is
played with. Nothing depends on who is fast or when a process was started again, and what was
inserted says which round it is, so a run that was stopped goes on where it was.
"""

from master.record.delivery import EpisodesArrived
from tangram_core.run.service import ServiceConfig
from tangram_core.spec import EpisodeSpec
from tangram_core.wire.arrays import check_batch_size
from tangram_core.wire.messages import Go


class Lockstep:
    """The rounds of a run, in which each of N players, 0 to N - 1, plays `batch_episodes`.

    Attributes:
        ordered: the players of this round know what to play.
    """

    def __init__(self, players: int, batch_episodes: int) -> None:
        self._players, self._size = players, batch_episodes
        self._arrived: dict[int, EpisodesArrived] = {}
        self.ordered = False

    @staticmethod
    def of(service: ServiceConfig, workers: int, spec: EpisodeSpec) -> "Lockstep | None":
        """The lockstep of the settings, None in any other mode.

        Raises:
            ConfigError: batches that are too large for one message.
        """
        if service.mode != "lockstep":
            return None
        size = service.batch_episodes(spec.horizon)
        check_batch_size(spec, size)
        return Lockstep(workers, size)

    def begins_round(self, episodes: int) -> bool:
        """Whether, with so many episodes inserted, the next one is the first of a round."""
        return episodes % (self._players * self._size) == 0

    def orders(self, version: int, episodes: int) -> dict[int, Go]:
        """Index -> what to play with the weights of a version, when so many were inserted."""
        number, done = divmod(episodes, self._players * self._size)
        first = number * self._size
        missing = range(done // self._size, self._players)
        return {i: Go(number, version, first, self._size) for i in missing}

    def take(self, arrival: EpisodesArrived) -> None:
        """A batch that was ordered has come, in any order of the players."""
        self._arrived[arrival.index] = arrival

    def next(self, episodes: int) -> EpisodesArrived | None:
        """The batch to insert after so many episodes, once all of its round have come."""
        index = episodes % (self._players * self._size) // self._size
        if not all(i in self._arrived for i in range(index, self._players)):
            return None
        return self._arrived[index]

    def inserted(self, arrival: EpisodesArrived) -> None:
        """Note that a batch was inserted; with the last one of a round the next round begins."""
        del self._arrived[arrival.index]
        if not self._arrived:
            self.ordered = False
