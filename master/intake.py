"""Batches on their way in: each is handed on once, and acknowledged when safe; see `ledger`."""

from collections.abc import Sequence

from master.arrivals import EpisodesArrived
from master.ledger import Verdict
from master.peers import Peer, Registry
from master.post import Post
from tangram_agent.messages import Ack, BatchError, EpisodeBatch, Greet, Reject


class Intake:
    """Judges batches by the ledgers of a registry."""

    def __init__(self, post: Post, registry: Registry, window: int) -> None:
        """Take nothing in yet.

        Args:
            post: answers.
            registry: who takes part.
            window: most unacknowledged batches of one peer.
        """
        self._post, self._registry, self._window = post, registry, window

    def batch(
        self, peer: Peer, batch: EpisodeBatch, frames: Sequence[bytes]
    ) -> Sequence[EpisodesArrived]:
        """The batch, if it is the next one; else what the worker must know is answered."""
        verdict = peer.ledger.judge(batch.sequence, self._window)
        if verdict is not Verdict.NEW:
            self._post.counters[verdict.value] += 1
            answer = peer.ledger.answer(verdict, batch.sequence)
            if answer is not None:
                self._post.send(peer.identity, answer)
            return ()
        peer.ledger.take(batch.sequence)
        peer.weights_version = batch.weights_version
        self._post.counters["batches"] += 1
        self._post.counters["episodes"] += batch.episodes.count
        return [EpisodesArrived(peer.role, peer.index, peer.incarnation, batch, frames)]

    def broken(self, identity: bytes, error: BatchError) -> None:
        """A batch with wrong content: it must not come again, and those after it need not wait."""
        peer = self._registry.find(identity)
        if peer is None:
            self._post.refuse(identity, "strangers", Greet())
            return
        final = peer.ledger.judge(error.sequence, self._window) is Verdict.NEW
        if final:
            peer.ledger.consume(error.sequence)
        reason = f"{peer.name}: batch {error.sequence}: {error}"
        answer = Reject(reason=reason, sequence=error.sequence, final=final)
        self._post.refuse(identity, "rejected", answer)

    def acknowledge(self, arrival: EpisodesArrived) -> None:
        """Tell the worker that its batch is safe, unless a newer process has the index."""
        key = (arrival.role, arrival.index)
        ledger = self._registry.ledger(key, arrival.incarnation)
        if ledger is None or arrival.sequence not in ledger.held:
            return
        ledger.held.discard(arrival.sequence)
        peer = self._registry.at(key)
        if peer is not None:
            peer.batches += 1
            peer.episodes += arrival.episodes.count
            peer.transitions += arrival.episodes.transitions
            self._post.send(peer.identity, Ack(arrival.sequence, duplicate=False))
