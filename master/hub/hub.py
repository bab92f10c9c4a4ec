"""The master's sockets: ROUTER for episodes, scores and control, PUB for weights.

Wrong messages never make `poll` raise: a wrong message is answered with a reason, counted by name
and dropped. Sends never wait: a peer that does not read loses its answers, and must ask again.

Delivery: see `delivery`. A batch is acknowledged only by `acknowledge`, after it was journalled and
inserted. The number of unacknowledged batches of one peer is limited by `window`.
"""

import secrets
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Self

from master.hub.admission import Admission, WelcomeInfo
from master.hub.fair import FairQueue
from master.hub.gate import AMPLE, Room
from master.hub.registry import OWN, Askers, Peer
from master.hub.security import Holder, Keys
from master.hub.sockets import Received, Sockets
from master.record.audit import Audit
from master.record.counters import Counters
from master.record.delivery import Arrival, EpisodesArrived, Exams, Verdict, Waiting
from master.record.journal import MARK
from tangram_core.agent import Weights
from tangram_core.errors import WireError
from tangram_core.scores import COUNTS
from tangram_core.wire.addresses import IPC
from tangram_core.wire.arrays import MAX_FRAMES, join_frames
from tangram_core.wire.messages import (
    GAP,
    Ack,
    Alive,
    AskStatus,
    BatchError,
    Bye,
    EpisodeBatch,
    Go,
    Greet,
    Heartbeat,
    Hello,
    Refused,
    Reject,
    RunStatus,
    Scores,
    Stop,
    ToMaster,
    WantWeights,
    WeightsMessage,
    decode_from_worker,
)
from tangram_core.wire.schema import DamagedError, ProtocolError

# Longest time for reading and for answering in one poll, so that load does not stop the loop.
READ_S, SERVE_S = 0.005, 0.01
MESSAGE_S = 0.1  # largest cost counted for one message; if longer, the process was stopped
# Most bytes of one key that are read but not answered. Messages beyond that are dropped, and a
# correct worker sends them again. Each message counts for LEAST_BYTES at least.
INBOX_BYTES, LEAST_BYTES = 128 * 2**20, 1024
# A peer must end after so many damaged messages without an intact batch between them.
MAX_DAMAGED = 100
# Bandwidth of broadcasts to all workers together: half of a gigabit line, and a fifteenth of a
# core for encryption. With many workers, weights get somewhat older, but learning does not slow.
BROADCAST_BYTES_S = 60e6


class Hub:
    """The master's side of the communication with workers, evaluators and tangram-status.

    Attributes:
        endpoint: address of the ROUTER socket, as bound.
        weights_endpoint: address of the PUB socket, as bound.
        epoch: random id of this master process; a restarted master has another one.
        counters: numbers of messages and refusals by name.
        open_to_all: whether anyone who reaches the port may take part.
    """

    def __init__(
        self,
        bind: str,
        port: int,
        info: WelcomeInfo,
        silence_s: float = 30.0,
        keys: Keys | None = None,
        room: Room = AMPLE,
        audit: Audit | None = None,
    ) -> None:
        """Open the sockets.

        Args:
            bind: address to listen on.
            port: port of the ROUTER; the PUB has the next one. 0 for any free ports.
            info: data that joining processes receive and must agree with.
            silence_s: seconds without a message after which a peer is removed.
            keys: keys for encrypted sockets; None for plain sockets.
            room: limits on connections and peers.
            audit: log of peers that join, leave or are refused.
        """
        self.epoch = secrets.token_hex(8)
        self._info = info
        self._weights: list[bytes] | None = None
        self._version, self._exams = -1, Exams()
        self._stop_reason: str | None = None
        self._status: list[bytes] | None = None
        self._askers = defaultdict[str, Askers](Askers)
        self._inbox, self._unread = FairQueue[tuple[Received, int]](), Counter[str]()
        self._orders: dict[int, Go] = {}
        self._waiting = Waiting(info.window, info.lockstep)
        self.counters = Counters()
        self._caller, self._address = Holder(), ""
        audit = audit or Audit()
        self._sockets = Sockets(bind, port, self.counters, keys, room, audit)
        self._admission = Admission(info, silence_s, room, self._sockets, self.counters, audit)
        self._registry = self._admission.registry
        self.endpoint = self._sockets.endpoint
        self.weights_endpoint = self._sockets.weights_endpoint
        self.open_to_all = keys is None and not self.endpoint.startswith(IPC)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def peers(self) -> list[Peer]:
        """Processes that take part, sorted by role and index."""
        return self._registry.peers

    def count(self, role: str) -> int:
        """Number of peers with a role."""
        return self._registry.count(role)

    @property
    def keys(self) -> Keys | None:
        """The keys as last read from their file; None on plain sockets."""
        return self._sockets.keys

    @property
    def broadcast_s(self) -> float:
        """Seconds to send the newest weights to all peers, at `BROADCAST_BYTES_S`."""
        size = sum(map(len, self._weights or ()))
        return size * len(self._registry) / BROADCAST_BYTES_S

    def poll(self, timeout_s: float) -> list[Arrival]:
        """Wait up to `timeout_s` for messages and answer them; returns new batches and scores."""
        self._admission.drop_revoked()  # first, so that a flood of messages cannot delay it
        if len(self._inbox) or self._sockets.wait(timeout_s):
            all_read = self._read()
            arrivals = self._serve()
            if len(self._inbox) or not all_read:  # peers that seem silent may have messages here
                return arrivals
        else:
            arrivals = []
        self._admission.drop_silent(time.monotonic())
        return arrivals

    def acknowledge(self, arrival: EpisodesArrived) -> None:
        """Acknowledge a batch to its worker; call once for each arrival, after the insert."""
        key = (arrival.role, arrival.index)
        self._waiting.done(arrival)
        ledger = self._registry.ledger(key, arrival.incarnation)
        if ledger is None or not ledger.release(arrival.sequence):
            return  # a newer process has the index, or the batch was acknowledged before
        peer = self._registry.at(key)
        if peer is not None:
            peer.inserted(arrival)
            self._sockets.answer(peer.identity, Ack(arrival.sequence, duplicate=False))

    def discards(self, arrival: EpisodesArrived) -> bool:
        """Drop a batch if its key was revoked; returns whether that was so."""
        keys = self.keys
        if keys is None or arrival.owner in keys.names:
            return False
        self._waiting.done(arrival)
        self._registry.retire((arrival.role, arrival.index), arrival.incarnation)
        return True

    def publish(self, weights: Weights) -> None:
        """Broadcast weights, and keep them for later requests; WireError if out of bounds."""
        self._weights = WeightsMessage(self.epoch, weights).encode()
        self._version = weights.version
        self._exams.published(weights.version)
        self._sockets.publish(join_frames(self._weights))
        self.counters["published"] += 1

    def order(self, orders: Mapping[int, Go]) -> None:
        """In lockstep: send each player (by index) its order, repeated until its batch arrives."""
        self._orders = dict(orders)
        for peer in self.peers:
            self._remind(peer)

    def tell(self, status: RunStatus) -> None:
        """Set the status that is sent to processes that ask for one."""
        self._status = status.encode()

    def stop(self, reason: str) -> None:
        """Tell all peers to end, and answer each later message in the same way.

        Peers leave with BYE: call `poll` until `peers` is empty or a time limit is over.
        """
        self._stop_reason = reason
        for peer in self.peers:
            self._sockets.answer(peer.identity, Stop(reason))

    def state(self) -> dict[str, dict[str, int | str]]:
        """The table of inserted batches, for a checkpoint; it serves to find duplicates."""
        return self._registry.state()

    def load_state(self, state: Mapping[str, Mapping[str, int | str]]) -> None:
        """Load a checkpoint's table of batches, before the first poll; RunError if malformed."""
        self._registry.load_state(state, time.monotonic())

    def recover(self, arrival: EpisodesArrived) -> bool:
        """Register a batch of the journal, before the first poll; False if it is a duplicate."""
        key = (arrival.role, arrival.index)
        sent, by = (arrival.incarnation, arrival.sequence), (arrival.process, arrival.owner)
        return self._registry.recover(key, *sent, time.monotonic(), *by)

    def recovered(self) -> None:
        """Free the indices of revoked keys; call this after the last `recover`."""
        self._admission.free_revoked()

    def close(self) -> None:
        """Close the sockets; queued answers get one second to be sent."""
        self._sockets.close()

    def _read(self) -> bool:
        """Move received messages to the inbox, for `READ_S` at most; False if more are left."""
        until_s = time.monotonic() + READ_S
        while (received := self._sockets.receive()) is not None:
            key, size = received.holder.name, max(LEAST_BYTES, sum(map(len, received.frames)))
            if self._unread[key] and self._unread[key] + size > INBOX_BYTES:
                self.counters.note("crowded_out", f"the key '{key}' sends more than can be read")
            else:
                self._unread[key] += size
                self._inbox.put(key, (received, size))
            if time.monotonic() >= until_s:
                return False
        return True

    def _serve(self) -> list[Arrival]:
        """Answer messages of the inbox, each key for an equal time; returns new arrivals."""
        arrivals: list[Arrival] = []
        begun_s = last_s = time.monotonic()
        while len(self._inbox):
            received, size = self._inbox.first()
            arrival = self._heard(received)
            now_s = time.monotonic()
            self._inbox.serve(min(now_s - last_s, MESSAGE_S))
            self._unread[received.holder.name] -= size
            if arrival is not None:
                arrivals.append(arrival)
            if (last_s := now_s) >= begun_s + SERVE_S:
                break
        return arrivals

    def _heard(self, received: Received) -> Arrival | None:
        """Handle a message if its sender's key is still valid; returns a new arrival, or None."""
        identity, frames, _, self._address, public = received
        holder = self._sockets.holder(public)  # the key may have been revoked since it was read
        if holder.revoked:
            self._admission.revoke(identity, holder.name)
            return None
        self._caller = holder
        return self._receive(identity, frames)

    def _receive(self, identity: bytes, frames: Sequence[bytes]) -> Arrival | None:
        """Decode and answer a message; returns a new arrival, or None."""
        message: ToMaster | BatchError
        try:
            if len(frames) > 1 + MAX_FRAMES:
                raise WireError(f"the message has {len(frames)} frames, at most {1 + MAX_FRAMES}")
            message = decode_from_worker(frames, self._info.spec)
        except ProtocolError as error:
            self._sockets.refuse(identity, "refused_protocol", Refused(str(error)))
        except DamagedError as error:
            self._damaged(identity, error)
        except BatchError as error:
            return self._dispatch(identity, error, frames)
        except WireError as error:
            self._sockets.refuse(identity, "malformed", Reject(str(error), sequence=0, final=True))
        else:
            return self._dispatch(identity, message, frames)
        return None

    def _dispatch(
        self, identity: bytes, message: ToMaster | BatchError, frames: Sequence[bytes]
    ) -> Arrival | None:
        """Handle messages that need no membership; pass the others of a peer to `_talk`."""
        peer = self._admission.find(identity, self._caller)
        if isinstance(message, AskStatus):
            if not self._askers[self._caller.name].may_have(identity, time.monotonic()):
                self.counters["status_asked_again"] += 1
            elif self._status is not None:
                self._sockets.send(identity, self._status)
        elif isinstance(message, Bye):
            self.counters["byes"] += 1
            if peer is not None:
                self._admission.leave(peer, message.reason)
        elif self._stop_reason is not None:
            # Batches get this answer, too, even wrong ones. They are not read any more, so the
            # worker must keep them.
            self._sockets.answer(identity, Stop(self._stop_reason))
        elif isinstance(message, Hello):
            who = (self._caller, self._address, self.epoch)
            joined = self._admission.hello(identity, message, *who, time.monotonic())
            if joined is not None:
                self._remind(joined)
        elif peer is None:
            self._sockets.refuse(identity, "strangers", Greet())
        else:
            peer.last_seen = time.monotonic()
            return self._talk(peer, message, frames)
        return None

    def _talk(
        self, peer: Peer, message: ToMaster | BatchError, frames: Sequence[bytes]
    ) -> Arrival | None:
        match message:
            case EpisodeBatch(sequence) if peer.role != "player":
                self._reject(peer, sequence, "episodes come from players only")
            case EpisodeBatch():
                return self._batch(peer, message, frames)
            case BatchError():
                self._broken(peer, message)
            case Scores() if peer.role != "evaluator":
                self._reject(peer, 0, "scores come from evaluators only")
            case Scores():
                return self._scores(peer, message)
            case Heartbeat(stats):
                self.counters["heartbeats"] += 1
                peer.stats = dict(stats)
                self._sockets.answer(peer.identity, Alive(self._version))
                self._remind(peer)
            case WantWeights(epoch, version):
                shown = version if epoch == self.epoch else -1
                if self._weights is None or shown == self._version:
                    return None
                if peer.may_have(self._version, shown):
                    self._sockets.send(peer.identity, self._weights)
                else:
                    self.counters["weights_asked_again"] += 1
        return None

    def _scores(self, peer: Peer, scores: Scores) -> Scores | None:
        """Check scores; another user's evaluator counts only while the run has none of its own."""
        odd = scores.scalars.keys() - self._info.scores - set(COUNTS)
        if odd:
            self._reject(peer, 0, f"scores: the task has no score named {min(odd)}")
            return None
        peer.damaged = 0
        if peer.holder not in OWN and self._registry.has_own("evaluator"):
            self._reject(peer, 0, "the run's own evaluator scores the weights", "excess_scores")
            return None
        if reason := self._exams.take(scores.weights_version, peer.index, peer.holder):
            self._reject(peer, 0, reason, "excess_scores")
            return None
        self.counters["scores"] += 1
        return scores

    def _batch(
        self, peer: Peer, batch: EpisodeBatch, frames: Sequence[bytes]
    ) -> EpisodesArrived | None:
        """Accept a batch if it is the next one; else answer the worker and return None."""
        peer.damaged = 0
        if MARK in join_frames(frames):
            self._broken(peer, BatchError(batch.sequence, "it has the mark of our records"))
            return None
        if self._info.lockstep and not self._is_ordered(peer, batch):
            return None
        room = self._waiting.room(peer.key, peer.ledger, len(self._registry))
        verdict = peer.ledger.take(batch.sequence, room)
        if verdict is not Verdict.NEW:
            self.counters[verdict.value] += 1
            answer = peer.ledger.answer(verdict, batch.sequence)
            if answer is not None:
                self._sockets.answer(peer.identity, answer)
            return None
        peer.weights_version = batch.weights_version
        self.counters["batches"] += 1
        self.counters["episodes"] += batch.episodes.count
        self._orders.pop(peer.index, None)
        who = (peer.role, peer.index, peer.incarnation)
        arrival = EpisodesArrived(*who, batch, frames, peer.process, peer.ledger.owner)
        self._waiting.add(arrival)
        return arrival

    def _is_ordered(self, peer: Peer, batch: EpisodeBatch) -> bool:
        """Whether a batch matches the player's order; else reject it and repeat the order."""
        if peer.ledger.judge(batch.sequence, self._info.window) is not Verdict.NEW:
            return True  # an old batch, which was checked when it was new
        order, number = self._orders.get(peer.index), batch.sequence
        if order is None:
            # Not final: after a restart of the master, the order may follow soon.
            reason = f"batch {number}: this player has no order now"
            self._reject(peer, number, reason, "not_ordered", final=False)
            return False
        if (batch.episodes.count, batch.weights_version) == (order.episodes, order.version):
            return True
        peer.ledger.consume(number)
        reason = (
            f"batch {number}: {batch.episodes.count} episodes with weights {batch.weights_version}"
            f", but the order was {order.episodes} with weights {order.version}"
        )
        self._reject(peer, number, reason, "not_ordered")
        self._remind(peer)
        return False

    def _broken(self, peer: Peer, error: BatchError) -> None:
        """Refuse a batch with wrong content for good, so that the batches after it can follow."""
        verdict = peer.ledger.judge(error.sequence, self._info.window)
        if verdict is Verdict.NEW:
            peer.ledger.consume(error.sequence)
        why = f"batch {peer.ledger.received + 1} {GAP}" if verdict is Verdict.GAP else error
        final = verdict in (Verdict.NEW, Verdict.INSERTED)
        self._reject(peer, error.sequence, f"batch {error.sequence}: {why}", final=final)

    def _damaged(self, identity: bytes, error: DamagedError) -> None:
        """Ask for a damaged message again; stop a peer after too many of them in a row."""
        peer = self._registry.find(identity)
        if peer is not None:
            peer.damaged += 1
            if peer.damaged >= MAX_DAMAGED:
                reason = (
                    f"{peer.damaged} messages of {peer.name} in a row were damaged on their way: "
                    "check the memory and the network of its machine"
                )
                self._sockets.refuse(identity, "damaged", Stop(reason))
                return
        self._sockets.refuse(identity, "damaged", Reject(str(error), sequence=0, final=False))

    def _reject(
        self, peer: Peer, sequence: int, reason: str, counter: str = "rejected", final: bool = True
    ) -> None:
        answer = Reject(f"{peer.name}: {reason}", sequence, final)
        self._sockets.refuse(peer.identity, counter, answer)

    def _remind(self, peer: Peer) -> None:
        """In lockstep: send a player its order again, in case the player missed it."""
        if peer.role == "player" and peer.index in self._orders:
            self._sockets.answer(peer.identity, self._orders[peer.index])
