"""The master's sockets: ROUTER for episodes, scores and control, PUB for weights.

Whatever a peer sends, `poll` does not raise: what is wrong is answered with a reason, counted by
name, and forgotten. A peer that does not read its answers loses them and nobody waits for it: the
worker asks again.

Delivery: see `delivery`. A batch is acknowledged only by `acknowledge`, after it was
journalled and inserted, and the unacknowledged batches of one peer are bounded by `window`.
"""

import secrets
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from master.audit import Audit
from master.counters import Counters
from master.delivery import Arrival, EpisodesArrived, ScoresArrived, Verdict
from master.gate import AMPLE, Room
from master.registry import Peer, RefusedError, Registry
from master.security import Holder, Keys
from master.sockets import Received, Sockets
from tangram_agent.addresses import IPC
from tangram_agent.arrays import MAX_FRAMES, EpisodeSpec, join_frames
from tangram_agent.messages import (
    ROLES,
    TAKEN_OVER,
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
    Welcome,
    decode_from_worker,
)
from tangram_agent.schema import DamagedError, Plain, ProtocolError
from tangram_agent.types import Weights
from tangram_sim.errors import WireError

# Most messages taken in one poll, so that the loop gets its turn under any load.
MAX_DRAIN = 256
# Damaged messages of one peer without an intact batch between them: then it must end.
MAX_DAMAGED = 100
# Peers that have left and whose batches still wait.
SPARE_PEERS = 64


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


class Hub:
    """The master's end of all conversations.

    Attributes:
        endpoint: of the ROUTER socket, as bound.
        weights_endpoint: of the PUB socket, as bound.
        epoch: random id of this life of the master.
        counters: traffic and refusals by name.
        open_to_all: whoever reaches the port may take part.
    """

    def __init__(
        self,
        bind: str,
        port: int,
        info: WelcomeInfo,
        silence_s: float = 30.0,
        keys: Keys | None = None,
        weights_port: int = 0,
        room: Room = AMPLE,
        audit: Audit | None = None,
    ) -> None:
        """Open the sockets.

        Args:
            bind: address to listen on.
            port: of the ROUTER, 0 for any.
            info: what joiners are told, and must agree with.
            silence_s: after which a peer is forgotten.
            keys: for encrypted sockets, None for plain ones.
            weights_port: of the PUB, 0 for any.
            room: for those who take part.
            audit: of who joins, leaves and is refused.
        """
        self.epoch = secrets.token_hex(8)
        self._info, self._silence_s = info, silence_s
        self._registry = Registry(info.fingerprints, silence_s, room)
        self._weights: list[bytes] | None = None
        self._version = -1
        self._stop_reason: str | None = None
        self._status: list[bytes] | None = None
        self._orders: dict[int, Go] = {}
        self._waiting = Counter[tuple[str, int]]()  # for their insert, of all processes of an index
        self.counters = Counters()
        self._audit, self._caller = audit or Audit(), Holder()
        self._address = ""
        self._sockets = Sockets(bind, port, self.counters, keys, weights_port, room, audit)
        self.endpoint = self._sockets.endpoint
        self.weights_endpoint = self._sockets.weights_endpoint
        self.open_to_all = keys is None and not self.endpoint.startswith(IPC)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def peers(self) -> list[Peer]:
        """Processes that take part, by role and index."""
        return self._registry.peers

    @property
    def keys(self) -> Keys | None:
        """As their file has them by now; None on plain sockets."""
        return self._sockets.keys

    def poll(self, timeout_s: float) -> list[Arrival]:
        """Wait for a message, then take and answer what is there.

        Returns:
            New batches and scores, in the order of their arrival.
        """
        arrivals: list[Arrival] = []
        self._sockets.listen_again()
        for holder in self._sockets.revoked():  # first: a flood must not keep anybody in
            for peer in [one for one in self.peers if one.holder == holder.name]:
                self._revoked(peer.identity, holder.name)
        if self._sockets.wait(timeout_s):
            for _ in range(MAX_DRAIN):
                received = self._sockets.receive()
                if received is None:
                    break
                arrival = self._heard(received)
                if arrival is not None:
                    arrivals.append(arrival)
            else:  # more is waiting, perhaps from those who seem silent
                return arrivals
        for peer in self._registry.drop_silent(time.monotonic(), self._silence_s):
            reason = f"{peer.name} was silent for {self._silence_s:g} s"
            self.counters.note("lost_peers", reason)
            self._tell_of("lost", peer, reason)
        return arrivals

    def acknowledge(self, arrival: EpisodesArrived) -> None:
        """Tell the worker that its batch is safe; once for each arrival, after its insert."""
        key = (arrival.role, arrival.index)
        self._waiting[key] -= 1
        if self._waiting[key] <= 0:
            del self._waiting[key]  # their sum is taken for each batch
        ledger = self._registry.ledger(key, arrival.incarnation)
        if ledger is None or not ledger.release(arrival.sequence):
            return  # a newer process has the index, or this was told before
        peer = self._registry.at(key)
        if peer is not None:
            peer.inserted(arrival)
            self._send(peer.identity, Ack(arrival.sequence, duplicate=False))

    def publish(self, weights: Weights) -> None:
        """Broadcast weights, and keep them for those who join later.

        Raises:
            WireError: they are not finite or too large; nothing is sent.
        """
        self._weights = WeightsMessage(self.epoch, weights).encode()
        self._version = weights.version
        self._sockets.publish(join_frames(self._weights))
        self.counters["published"] += 1

    def order(self, orders: Mapping[int, Go]) -> None:
        """In lockstep: tell players what to play next, by index, until their batches come."""
        self._orders = dict(orders)
        for peer in self.peers:
            self._remind(peer)

    def tell(self, status: RunStatus) -> None:
        """Answer with this whoever asks how the run stands."""
        self._status = status.encode()

    def stop(self, reason: str) -> None:
        """Tell all peers to end, and from now on whoever says anything.

        They leave with BYE: poll until `peers` is empty or your patience ends.
        """
        self._stop_reason = reason
        for peer in self.peers:
            self._send(peer.identity, Stop(reason))

    def state(self) -> dict[str, dict[str, int | str]]:
        """The table of duplicates, for a checkpoint."""
        return self._registry.state()

    def load_state(self, state: Mapping[str, Mapping[str, int | str]]) -> None:
        """Take the table of duplicates of a checkpoint, before the first poll.

        Raises:
            RunError: malformed.
        """
        self._registry.load_state(state, time.monotonic())

    def recover(self, arrival: EpisodesArrived) -> bool:
        """Note a batch of the journal, before the first poll; False if it was inserted before."""
        key = (arrival.role, arrival.index)
        sent = (arrival.incarnation, arrival.sequence)
        return self._registry.recover(key, *sent, time.monotonic(), arrival.process)

    def close(self) -> None:
        """Close the sockets; answers that are on their way get a second."""
        self._sockets.close()

    def _heard(self, received: Received) -> Arrival | None:
        """Read a message, if its sender still has a key; returns what is new."""
        identity, frames, holder, self._address = received
        if holder.revoked:
            self._revoked(identity, holder.name)
            return None
        self._caller = holder
        return self._receive(identity, frames)

    def _revoked(self, identity: bytes, name: str) -> None:
        peer, reason = self._registry.find(identity), f"the key {name} was revoked"
        if peer is not None:
            self._registry.leave(peer)
            self._tell_of("refused", peer, reason)
        self._refuse(identity, "revoked", Stop(reason))

    def _receive(self, identity: bytes, frames: Sequence[bytes]) -> Arrival | None:
        """Read a message and answer it; returns what is new."""
        message: ToMaster | BatchError
        try:
            if len(frames) > 1 + MAX_FRAMES:
                raise WireError(f"the message has {len(frames)} frames, at most {1 + MAX_FRAMES}")
            message = decode_from_worker(frames, self._info.spec)
        except ProtocolError as error:
            self._refuse(identity, "refused_protocol", Refused(str(error)))
        except DamagedError as error:
            self._damaged(identity, error)
        except BatchError as error:
            return self._dispatch(identity, error, frames)
        except WireError as error:
            self._refuse(identity, "malformed", Reject(str(error), sequence=0, final=True))
        else:
            return self._dispatch(identity, message, frames)
        return None

    def _dispatch(
        self, identity: bytes, message: ToMaster | BatchError, frames: Sequence[bytes]
    ) -> Arrival | None:
        """Those who need not take part, and those who may not any more."""
        peer = self._registry.find(identity)
        if peer is not None and peer.holder != self._caller.name:
            peer = None  # the name of a connection is no proof
        if isinstance(message, AskStatus):
            if self._status is not None:
                self._sockets.send(identity, self._status)
        elif isinstance(message, Bye):
            self.counters["byes"] += 1
            if peer is not None:
                self._registry.leave(peer)
                self._tell_of("left", peer, message.reason)
        elif self._stop_reason is not None:
            # Batches, too, right and wrong ones: none is taken, so none may be refused for good.
            self._send(identity, Stop(self._stop_reason))
        elif isinstance(message, Hello):
            self._hello(identity, message)
        elif peer is None:
            self._refuse(identity, "strangers", Greet())
        else:
            peer.last_seen = time.monotonic()
            return self._talk(peer, message, frames)
        return None

    def _talk(
        self, peer: Peer, message: ToMaster | BatchError, frames: Sequence[bytes]
    ) -> Arrival | None:
        match message:
            case EpisodeBatch(sequence) if peer.role != "player":
                self._not_its_role(peer, sequence, "episodes come from players only")
            case EpisodeBatch():
                return self._batch(peer, message, frames)
            case BatchError():
                self._broken(peer, message)
            case Scores() if peer.role != "evaluator":
                self._not_its_role(peer, 0, "scores come from evaluators only")
            case Scores():
                peer.damaged = 0
                self.counters["scores"] += 1
                return ScoresArrived(peer.index, peer.incarnation, message)
            case Heartbeat(stats):
                self.counters["heartbeats"] += 1
                peer.stats = dict(stats)
                self._send(peer.identity, Alive(self._version))
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

    def _batch(
        self, peer: Peer, batch: EpisodeBatch, frames: Sequence[bytes]
    ) -> EpisodesArrived | None:
        """The batch, if it is the next one; else what the worker must know is answered."""
        peer.damaged = 0
        if self._info.lockstep and not self._is_ordered(peer, batch):
            return None
        verdict = peer.ledger.take(batch.sequence, self._room_for(peer))
        if verdict is not Verdict.NEW:
            self.counters[verdict.value] += 1
            answer = peer.ledger.answer(verdict, batch.sequence)
            if answer is not None:
                self._send(peer.identity, answer)
            return None
        peer.weights_version = batch.weights_version
        self.counters["batches"] += 1
        self.counters["episodes"] += batch.episodes.count
        self._orders.pop(peer.index, None)
        self._waiting[peer.key] += 1
        return EpisodesArrived(peer.role, peer.index, peer.incarnation, batch, frames, peer.process)

    def _room_for(self, peer: Peer) -> int:
        """How many batches of a process may wait; those of processes before it count, too."""
        window = self._info.window
        if self._waiting.total() >= window * (len(self.peers) + SPARE_PEERS):
            return 0
        return window - self._waiting[peer.key] + len(peer.ledger.held)

    def _is_ordered(self, peer: Peer, batch: EpisodeBatch) -> bool:
        """Whether a new batch is what the player was told to play; else it is told again."""
        if peer.ledger.judge(batch.sequence, self._info.window) is not Verdict.NEW:
            return True  # it was, when it was new
        order, told = self._orders.get(peer.index), f"{peer.name}: batch {batch.sequence}"
        if order is None:
            # After a restart its order may come soon: it is not refused for good.
            reason = f"{told}: nothing is ordered of it now"
            self._refuse(peer.identity, "not_ordered", Reject(reason, batch.sequence, final=False))
            return False
        if (batch.episodes.count, batch.weights_version) == (order.episodes, order.version):
            return True
        peer.ledger.consume(batch.sequence)
        reason = (
            f"{told}: {batch.episodes.count} episodes with weights {batch.weights_version}, "
            f"ordered were {order.episodes} with weights {order.version}"
        )
        self._refuse(peer.identity, "not_ordered", Reject(reason, batch.sequence, final=True))
        self._remind(peer)
        return False

    def _broken(self, peer: Peer, error: BatchError) -> None:
        """A batch with wrong content: it must not come again, and those after it need not wait."""
        final = peer.ledger.judge(error.sequence, self._info.window) is Verdict.NEW
        if final:
            peer.ledger.consume(error.sequence)
        reason = f"{peer.name}: batch {error.sequence}: {error}"
        self._refuse(peer.identity, "rejected", Reject(reason, error.sequence, final))

    def _damaged(self, identity: bytes, error: DamagedError) -> None:
        """Told, so that what was meant comes again soon, unless that happens time after time."""
        peer = self._registry.find(identity)
        if peer is not None:
            peer.damaged += 1
            if peer.damaged >= MAX_DAMAGED:
                reason = (
                    f"{peer.damaged} messages of {peer.name} in a row were damaged on their way: "
                    "look at the memory and the network of its machine"
                )
                self._refuse(identity, "damaged", Stop(reason))
                return
        self._refuse(identity, "damaged", Reject(str(error), sequence=0, final=False))

    def _not_its_role(self, peer: Peer, sequence: int, rule: str) -> None:
        reason = f"{peer.name}: {rule}"
        self._refuse(peer.identity, "rejected", Reject(reason, sequence, final=True))

    def _hello(self, identity: bytes, hello: Hello) -> None:
        run_id = self._info.run_id
        if hello.run_id not in ("", run_id):
            reason = (
                f"this master runs '{run_id}', not '{hello.run_id}': the connection file is stale, "
                "take the one of a master that is running"
            )
            self._refuse_hello(identity, hello, "refused_run", Refused(reason))
            return
        reason = self._not_with_this_key(hello)
        if reason:
            self._refuse_hello(identity, hello, "refused_keys", Refused(reason))
            return
        try:
            peer, older = self._registry.admit(identity, hello, time.monotonic())
        except RefusedError as error:
            self._refuse_hello(identity, hello, error.counter, error.answer)
            return
        if older is not None:
            reason = f"{peer.name} {TAKEN_OVER}"
            self._tell_of("superseded", older, reason)
            self._refuse(older.identity, "superseded", Stop(reason))
        before, peer.address, peer.holder = peer.address, self._address, self._caller.name
        if before is None:
            self._tell_of("joined", peer)
        self.counters["welcomed"] += 1
        lost = self._registry.lost_batches - self.counters["lost_batches"]
        self.counters["lost_batches"] += lost
        if lost:
            reason = (
                f"{peer.name} says that {lost:,} of its batches were acknowledged which are not in "
                "the replay: the disk has lost them, if it is right"
            )
            self.counters.note("losses", reason)
        self._send(identity, self._welcome(peer))
        self._remind(peer)

    def _not_with_this_key(self, hello: Hello) -> str:
        """Why a key does not let a process take part as it wants to; empty if it does."""
        name, role = self._caller.name, self._caller.role
        if role not in ("", hello.role):
            return f"the key '{name}' is one for role={role}, not for role={hello.role}"
        for peer in self.peers:
            its = peer.process == hello.process or peer.key == (hello.role, hello.index)
            # What the run starts itself has its place: a key that was given away gets another.
            if its and peer.holder != name and name not in ROLES:
                return (
                    f"{peer.name} takes part with another key: leave index out, or choose another"
                )
        return ""

    def _refuse_hello(
        self, identity: bytes, hello: Hello, counter: str, answer: Refused | Stop
    ) -> None:
        who = {"role": hello.role, "index": hello.index, "process": hello.process}
        where = {"key": self._caller.name, "address": self._address, "reason": answer.reason}
        self._audit.note("refused", **who, **where)
        self._refuse(identity, counter, answer)

    def _tell_of(self, event: str, peer: Peer, reason: str = "") -> None:
        """One line of the audit."""
        who = {"role": peer.role, "index": peer.index, "incarnation": peer.incarnation}
        where = {"process": peer.process, "key": peer.holder, "address": peer.address}
        self._audit.note(event, **who, **where, **({"reason": reason} if reason else {}))

    def _welcome(self, peer: Peer) -> Welcome:
        return Welcome(
            epoch=self.epoch,
            run_id=self._info.run_id,
            seed=self._info.seed,
            index=peer.index,
            incarnation=peer.incarnation,
            weights_endpoint=self.weights_endpoint,
            window=self._info.window,
            lockstep=self._info.lockstep,
        )

    def _remind(self, peer: Peer) -> None:
        """In lockstep: tell a player, who may have missed it, what is still to play."""
        if peer.role == "player" and peer.index in self._orders:
            self._send(peer.identity, self._orders[peer.index])

    def _refuse(
        self, identity: bytes, counter: str, answer: Reject | Refused | Stop | Greet
    ) -> None:
        """Send a reason, count it and tell it."""
        self.counters.note(counter, getattr(answer, "reason", "a connection without HELLO"))
        self._send(identity, answer)

    def _send(self, identity: bytes, answer: Plain) -> None:
        """Send to a peer, unless it is gone or does not read."""
        self._sockets.send(identity, answer.encode())
