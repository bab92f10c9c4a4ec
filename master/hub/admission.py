"""Admission: which processes may take part, with which key and settings; writes the audit log.

A process without a key of the run is stopped earlier, at the sockets (`security`, `gate`). The
registry manages indices and incarnations.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from master.hub.gate import Room
from master.hub.registry import Peer, RefusedError, Registry, another_key
from master.hub.security import Holder
from master.hub.sockets import Sockets
from master.record.audit import Audit
from master.record.counters import Counters
from tangram_core.spec import EpisodeSpec
from tangram_core.wire.messages import ROLES, TAKEN_OVER, Hello, Refused, Stop, Welcome


@dataclass(frozen=True)
class WelcomeInfo:
    """Data that the master sends to a joining process or checks; see `Welcome` and `Hello`.

    Attributes:
        fingerprints: digest of each section of the settings; a joining process must have the same.
        spec: shapes and dtypes that the arrays of a batch must have.
        window: largest number of unacknowledged batches of one player.
        lockstep: whether the run is in lockstep mode.
        scores: names of the scores that an evaluator may report.
    """

    run_id: str
    seed: int
    fingerprints: Mapping[str, str]
    spec: EpisodeSpec
    window: int = 4
    lockstep: bool = False
    scores: frozenset[str] = frozenset()


class Admission:
    """Admits and removes processes, answers them, and writes the audit log.

    Attributes:
        registry: the processes that take part.
    """

    def __init__(
        self,
        info: WelcomeInfo,
        silence_s: float,
        room: Room,
        sockets: Sockets,
        counters: Counters,
        audit: Audit,
    ) -> None:
        grace_s = 0.0 if info.lockstep else silence_s  # its orders name the first indices only
        self.registry = Registry(info.fingerprints, grace_s, room)
        self._info, self._silence_s = info, silence_s
        self._sockets, self._counters, self._audit = sockets, counters, audit

    def find(self, identity: bytes, caller: Holder) -> Peer | None:
        """The peer of a connection, None if the key is not the peer's: identities can be forged."""
        peer = self.registry.find(identity)
        return peer if peer is not None and peer.holder == caller.name else None

    def hello(
        self, identity: bytes, hello: Hello, caller: Holder, address: str, epoch: str, now: float
    ) -> Peer | None:
        """Answer a HELLO with a welcome or a refusal; returns the peer, None if refused."""
        try:
            self._check(hello, caller)
            peer, older = self.registry.admit(identity, hello, now, caller.name)
        except RefusedError as error:
            who = {"role": hello.role, "index": hello.index, "process": hello.process}
            where = {"key": caller.name, "address": address, "reason": error.answer.reason}
            self._audit.note("refused", **who, **where)
            self._sockets.refuse(identity, error.counter, error.answer)
            return None
        if older is not None:
            reason = f"{peer.name} {TAKEN_OVER}"
            self._tell_of("superseded", older, reason)
            self._sockets.refuse(older.identity, "superseded", Stop(reason))
        before, peer.address, peer.holder = peer.address, address, caller.name
        if before is None:
            self._tell_of("joined", peer)
        self._counters["welcomed"] += 1
        self._tell_losses(peer)
        self._sockets.answer(identity, self._welcome(peer, epoch))
        return peer

    def leave(self, peer: Peer, reason: str) -> None:
        """Remove a peer that said goodbye."""
        self.registry.leave(peer)
        self._tell_of("left", peer, reason)

    def drop_silent(self, now: float) -> None:
        """Remove the peers that sent no message for `silence_s`."""
        for peer in self.registry.drop_silent(now, self._silence_s):
            reason = f"{peer.name} was silent for {self._silence_s:g} s"
            self._counters.note("lost_peers", reason)
            self._tell_of("lost", peer, reason)

    def drop_revoked(self) -> None:
        """Remove the peers whose keys were revoked since the last call."""
        gone = self._sockets.revoked()
        for holder in gone:
            for peer in [one for one in self.registry.peers if one.holder == holder.name]:
                self.revoke(peer.identity, holder.name)
        if gone:
            self.free_revoked()

    def free_revoked(self) -> None:
        """Free the indices of keys that are not in the key file any more."""
        keys = self._sockets.keys
        self.registry.free_all_but(set() if keys is None else keys.names)

    def revoke(self, identity: bytes, key: str) -> None:
        """Refuse a connection whose key was revoked, and remove its peer if there is one."""
        peer, reason = self.registry.find(identity), f"the key {key} was revoked"
        if peer is not None:
            self.registry.leave(peer)
            self._tell_of("refused", peer, reason)
        self._sockets.refuse(identity, "revoked", Stop(reason))

    def _check(self, hello: Hello, caller: Holder) -> None:
        """Raise RefusedError if the run is another one, or the key does not allow this role."""
        if hello.run_id not in ("", self._info.run_id):
            reason = (
                f"this master runs '{self._info.run_id}', not '{hello.run_id}': the connection "
                "file is stale, use the file of a running master"
            )
            raise RefusedError("refused_run", Refused(reason, later=True))
        if caller.role not in ("", hello.role):
            reason = f"the key '{caller.name}' is for role={caller.role}, not for role="
            raise RefusedError("refused_keys", Refused(reason + hello.role))
        for peer in self.registry.peers:
            its = peer.process == hello.process or peer.key == (hello.role, hello.index)
            # The run's own workers (keys in ROLES) may take their index back from any other key.
            if its and peer.holder != caller.name and caller.name not in ROLES:
                raise another_key(peer.name, hello)

    def _tell_losses(self, peer: Peer) -> None:
        lost = self.registry.lost_batches - self._counters["lost_batches"]
        self._counters["lost_batches"] += lost
        if lost:
            reason = (
                f"{peer.name} reports {lost:,} acknowledged batches that are not in the replay: if "
                "this is right, the disk has lost them"
            )
            self._counters.note("losses", reason)

    def _welcome(self, peer: Peer, epoch: str) -> Welcome:
        return Welcome(
            epoch=epoch,
            run_id=self._info.run_id,
            seed=self._info.seed,
            index=peer.index,
            incarnation=peer.incarnation,
            weights_endpoint=self._sockets.weights_endpoint,
            window=self._info.window,
            lockstep=self._info.lockstep,
        )

    def _tell_of(self, event: str, peer: Peer, reason: str = "") -> None:
        """Write one line of the audit log."""
        who = {"role": peer.role, "index": peer.index, "incarnation": peer.incarnation}
        where = {"process": peer.process, "key": peer.holder, "address": peer.address}
        self._audit.note(event, **who, **where, **({"reason": reason} if reason else {}))
