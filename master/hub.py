"""The master's sockets: ROUTER for episodes, scores and control, PUB for weights.

Whatever a peer sends, `poll` does not raise: what is wrong is answered with a reason, counted by
name, and forgotten. A peer that does not read its answers loses them and nobody waits for it: the
worker asks again.

Delivery: see `ledger`. A batch is acknowledged only by `acknowledge`, after it was
journalled and inserted, and the unacknowledged batches of one peer are bounded by `window`.
"""

import secrets
import time
from collections.abc import Mapping, Sequence
from typing import Any, Self

from master.arrivals import Arrival, EpisodesArrived, ScoresArrived, WelcomeInfo
from master.intake import Intake
from master.keys import Keys
from master.orders import Orders
from master.peers import Peer, RefusedError, Registry
from master.post import Post
from tangram_agent.arrays import join_frames
from tangram_agent.messages import (
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
from tangram_agent.schema import DamagedError, ProtocolError
from tangram_agent.types import Weights
from tangram_sim.errors import WireError

# Most messages taken in one poll, so that the loop gets its turn under any load.
MAX_DRAIN = 256


class Hub:
    """The master's end of all conversations.

    Attributes:
        endpoint: of the ROUTER socket, as bound.
        weights_endpoint: of the PUB socket, as bound.
        epoch: random id of this life of the master.
        counters: traffic and refusals by name.
    """

    def __init__(
        self,
        bind: str,
        port: int,
        info: WelcomeInfo,
        silence_s: float = 30.0,
        keys: Keys | None = None,
        weights_port: int = 0,
    ) -> None:
        """Open the sockets.

        Args:
            bind: address to listen on.
            port: of the ROUTER, 0 for any.
            info: what joiners are told, and must agree with.
            silence_s: after which a peer is forgotten.
            keys: for encrypted sockets, None for plain ones.
            weights_port: of the PUB, 0 for any.
        """
        self.epoch = secrets.token_hex(8)
        self._info, self._silence_s = info, silence_s
        self._registry = Registry(info.fingerprints, silence_s)
        self._weights: list[bytes] | None = None
        self._version = -1
        self._stop_reason: str | None = None
        self._status: list[bytes] | None = None
        self._post = Post(bind, port, keys, weights_port)
        self._sockets, self.counters = self._post.sockets, self._post.counters
        self._orders = Orders(self._post)
        self._intake = Intake(self._post, self._registry, info.window)
        self.endpoint = self._sockets.endpoint
        self.weights_endpoint = self._sockets.weights_endpoint

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def peers(self) -> list[Peer]:
        """Processes that take part, by role and index."""
        return self._registry.peers

    def poll(self, timeout_s: float) -> list[Arrival]:
        """Wait for a message, then take and answer what is there.

        Returns:
            New batches and scores, in the order of their arrival.
        """
        arrivals: list[Arrival] = []
        if self._sockets.wait(timeout_s):
            for _ in range(MAX_DRAIN):
                received = self._sockets.receive()
                if received is None:
                    break
                arrivals.extend(self._receive(*received))
            else:  # more is waiting, perhaps from those who seem silent
                return arrivals
        for peer in self._registry.drop_silent(time.monotonic(), self._silence_s):
            self.counters.note("lost_peers", f"{peer.name} was silent for {self._silence_s:g} s")
        return arrivals

    def acknowledge(self, arrival: EpisodesArrived) -> None:
        """Tell the worker that its batch is safe; once for each arrival, after its insert."""
        self._intake.acknowledge(arrival)

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
        """In lockstep: tell players what to play next, by index."""
        self._orders.give(orders, self.peers)

    def tell(self, status: RunStatus) -> None:
        """Answer with this whoever asks how the run stands."""
        self._status = status.encode()

    def stop(self, reason: str) -> None:
        """Tell all peers to end, and from now on whoever says anything.

        They leave with BYE: poll until `peers` is empty or your patience ends.
        """
        self._stop_reason = reason
        for peer in self.peers:
            self._post.send(peer.identity, Stop(reason))

    def state(self) -> dict[str, dict[str, int]]:
        """The table of duplicates, for a checkpoint."""
        return self._registry.state()

    def load_state(self, state: Mapping[str, Mapping[str, int]]) -> None:
        """Take the table of duplicates of a checkpoint, before the first poll.

        Raises:
            RunError: malformed.
        """
        self._registry.load_state(state, time.monotonic())

    def recover(self, arrival: EpisodesArrived) -> bool:
        """Note a batch of the journal, before the first poll; False if it was inserted before."""
        key = (arrival.role, arrival.index)
        return self._registry.recover(key, arrival.incarnation, arrival.sequence, time.monotonic())

    def close(self) -> None:
        """Close the sockets; answers that are on their way get a second."""
        self._sockets.close()

    def _receive(self, identity: bytes, frames: Sequence[bytes]) -> Sequence[Arrival]:
        try:
            message = decode_from_worker(frames, self._info.spec)
        except ProtocolError as error:
            self._post.refuse(identity, "refused_protocol", Refused(str(error)))
        except DamagedError as error:
            # Told, so that what was meant comes again, and not final: its number is not believed.
            reject = Reject(reason=str(error), sequence=0, final=False)
            self._post.refuse(identity, "damaged", reject)
        except BatchError as error:
            if self._stop_reason is None:  # else what comes is not judged any more
                self._intake.broken(identity, error)
            else:
                self._post.send(identity, Stop(self._stop_reason))
        except WireError as error:
            reject = Reject(reason=str(error), sequence=0, final=True)
            self._post.refuse(identity, "malformed", reject)
        else:
            return self._dispatch(identity, message, frames)
        return ()

    def _dispatch(
        self, identity: bytes, message: ToMaster, frames: Sequence[bytes]
    ) -> Sequence[Arrival]:
        peer = self._registry.find(identity)
        if isinstance(message, AskStatus):
            if self._status is not None:
                self._sockets.send(identity, self._status)
        elif isinstance(message, Bye):
            self.counters["byes"] += 1
            if peer is not None:
                self._registry.leave(peer)
        elif self._stop_reason is not None:
            self._post.send(identity, Stop(self._stop_reason))
        elif isinstance(message, Hello):
            self._hello(identity, message)
        elif peer is None:
            self._post.refuse(identity, "strangers", Greet())
        else:
            peer.last_seen = time.monotonic()
            return self._talk(peer, message, frames)
        return ()

    def _talk(self, peer: Peer, message: Any, frames: Sequence[bytes]) -> Sequence[Arrival]:
        match message:
            case EpisodeBatch(sequence) if peer.role != "player":
                self._not_its_role(peer, sequence, "episodes come from players only")
            case EpisodeBatch():
                arrived = self._intake.batch(peer, message, frames)
                if arrived:  # and not one that was sent again
                    self._orders.done(peer)
                return arrived
            case Scores() if peer.role != "evaluator":
                self._not_its_role(peer, 0, "scores come from evaluators only")
            case Scores():
                self.counters["scores"] += 1
                return [ScoresArrived(peer.index, peer.incarnation, message)]
            case Heartbeat(stats):
                self.counters["heartbeats"] += 1
                peer.stats = dict(stats)
                self._post.send(peer.identity, Alive(self._version))
                self._orders.remind(peer)
            case WantWeights(epoch, version):
                if self._weights is not None and (epoch, version) != (self.epoch, self._version):
                    self._sockets.send(peer.identity, self._weights)
        return ()

    def _not_its_role(self, peer: Peer, sequence: int, rule: str) -> None:
        answer = Reject(reason=f"{peer.name}: {rule}", sequence=sequence, final=True)
        self._post.refuse(peer.identity, "rejected", answer)

    def _hello(self, identity: bytes, hello: Hello) -> None:
        try:
            peer, older = self._registry.admit(identity, hello, time.monotonic())
        except RefusedError as error:
            self._post.refuse(identity, error.counter, error.answer)
            return
        if older is not None:
            reason = f"{peer.name} was taken over by a newer process"
            self._post.refuse(older.identity, "superseded", Stop(reason))
        self.counters["welcomed"] += 1
        self.counters["lost_batches"] = self._registry.lost_batches
        self._post.send(identity, self._welcome(peer))
        self._orders.remind(peer)

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
