"""Who takes part: indices, incarnations and connections; no sockets.

Each role counts its own indices. A new process of an index gets the next incarnation and wins over
the older one; a process that comes back after the master was restarted keeps what it had, unless
the master has lost it (a disk without power): then it gets the next one, too. No process names one
that was never given. An index stays with the key that had it first: no other key goes on with its
batches, or begins anew there.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

from master.hub.gate import AMPLE, Room
from master.record.delivery import EpisodesArrived, Ledger
from tangram_core.errors import RunError, TangramError
from tangram_core.wire.messages import MAX_ID, MAX_INDEX, ROLES, TAKEN_OVER, Hello, Refused, Stop
from tangram_core.wire.schema import MAX_COUNT

CROWDED = 0.9  # share of the room from which on there is a warning
# One that asks for weights again before it has shown that it got them waits so long, then twice.
WEIGHTS_AGAIN_S = 10.0
# Answers about the run: so many in this time over all who ask, and one for each connection.
STATUS_ANSWERS, STATUS_AGAIN_S = 64, 0.5
ANOTHER_KEY = "takes part with another key: leave index out, or choose another"
Key = tuple[str, int]

log = logging.getLogger(__name__)


class RefusedError(TangramError):
    """A process that may not take part: the counter of such refusals, and the answer to it."""

    def __init__(self, counter: str, answer: Refused | Stop) -> None:
        super().__init__(answer.reason)
        self.counter, self.answer = counter, answer


@dataclass(eq=False)
class Peer:
    """A connected process.

    Attributes:
        process: its random id.
        last_seen: monotonic seconds.
        stats: numbers of its last heartbeat.
        weights_version: that its last batch was played with.
        batches, episodes, transitions: inserted since it joined.
        damaged: messages in a row that were damaged on their way.
        holder: name of the key that it joined with, empty where there are none.
        address: where it is; None before it has joined.
        weights: version that it was sent when it asked, and when it may have more if it does not
            show that it got them.
    """

    role: str
    index: int
    incarnation: int
    process: str
    identity: bytes
    last_seen: float
    ledger: Ledger
    stats: dict[str, float] = field(default_factory=dict)
    weights_version: int = -1
    batches: int = 0
    episodes: int = 0
    transitions: int = 0
    damaged: int = 0
    holder: str = ""
    address: str | None = None
    weights: tuple[int, float] = (-1, 0.0)
    _patience_s: float = WEIGHTS_AGAIN_S

    def may_have(self, version: int, shown: int) -> bool:
        """Whether to send it weights of a version; it shows which it has.

        What is sent to one that does not read stays in memory here.
        """
        sent, due = self.weights
        if shown < sent and self.last_seen < due:
            return False
        self._patience_s = WEIGHTS_AGAIN_S if shown >= sent else 2.0 * self._patience_s
        self.weights = version, self.last_seen + self._patience_s
        return True

    def inserted(self, arrival: EpisodesArrived) -> None:
        """Count a batch of its own."""
        self.batches += 1
        self.episodes += arrival.episodes.count
        self.transitions += arrival.episodes.transitions

    @property
    def key(self) -> Key:
        """Role and index."""
        return self.role, self.index

    @property
    def name(self) -> str:
        """Role and index in words, for messages to people."""
        return f"{self.role} {self.index}"


class Registry:
    """Peers by connection and by index, and the ledger of batches of each, for a checkpoint.

    After a restart indices wait `grace_s` for their workers.

    Attributes:
        lost_batches: numbers that a checkpoint had not seen and a worker has no more.
    """

    def __init__(self, fingerprints: Mapping[str, str], grace_s: float, room: Room = AMPLE) -> None:
        self._room, self._crowded = room, False
        self.lost_batches = 0
        self._fingerprints = fingerprints
        self._grace_s, self._reserved_until = grace_s, 0.0
        self._by_identity: dict[bytes, Peer] = {}
        self._by_key: dict[Key, Peer] = {}
        self._ledgers: dict[Key, Ledger] = {}
        self._recovered = dict[tuple[Key, int], int]()  # last batch of each incarnation

    @property
    def peers(self) -> list[Peer]:
        """Live ones, by role and index."""
        return [self._by_key[key] for key in sorted(self._by_key)]

    def __len__(self) -> int:
        """How many are live."""
        return len(self._by_key)

    def count(self, role: str) -> int:
        """How many of a role are live."""
        return sum(one == role for one, _ in self._by_key)

    def find(self, identity: bytes) -> Peer | None:
        """The peer of a connection."""
        return self._by_identity.get(identity)

    def at(self, key: Key) -> Peer | None:
        """The peer of an index."""
        return self._by_key.get(key)

    def ledger(self, key: Key, incarnation: int) -> Ledger | None:
        """The batches of an incarnation, unless a newer one has begun."""
        ledger = self._ledgers.get(key)
        return ledger if ledger is not None and ledger.incarnation == incarnation else None

    def admit(
        self, identity: bytes, hello: Hello, now: float, owner: str = ""
    ) -> tuple[Peer, Peer | None]:
        """Take a process in: the newest of an index wins.

        Args:
            identity: its connection.
            hello: what it says.
            now: monotonic seconds.
            owner: name of its key.

        Returns:
            The peer, and the older process that it took the index from.

        Raises:
            RefusedError: other settings, too many peers, or an index that belongs to a newer
                incarnation, or to another key.
        """
        self._check_settings(hello)
        same = next((p for p in self._by_key.values() if p.process == hello.process), None)
        if same is not None and same.role == hello.role:
            # A HELLO again, because WELCOME was late or the connection is a new one.
            self._by_identity.pop(same.identity, None)
            same.identity, same.last_seen = identity, now
            self._by_identity[identity] = same
            return same, None
        # One that takes an index over needs no more room: its predecessor leaves.
        takes_over = (hello.role, hello.index) in self._by_key
        if len(self._by_key) >= self._room.peers and not takes_over:
            reason = f"{self._room.peers} processes take part already, the most {self._room.bound}"
            raise RefusedError("refused_full", Refused(reason, later=True))
        stranger = self._by_identity.get(identity)
        if stranger is not None:
            self.leave(stranger)
        index = hello.index if hello.index >= 0 else self._free_index(hello.role, now, owner)
        key = (hello.role, index)
        # What the run starts itself has its place: a key that was given away gets another.
        if key in self._ledgers and not self._ledgers[key].is_of(owner) and owner not in ROLES:
            reason = f"{hello.role} {index} {ANOTHER_KEY}"
            raise RefusedError("refused_keys", Refused(reason))
        ledger = self._open_ledger(key, hello, owner)
        older = self._by_key.get(key)
        if older is not None:
            self.leave(older)
        peer = Peer(hello.role, index, ledger.incarnation, hello.process, identity, now, ledger)
        self._by_identity[identity] = self._by_key[key] = peer
        self._warn_early()
        return peer, older

    def leave(self, peer: Peer) -> None:
        """Forget a connection; its ledger stays, unless no batch of its index was ever taken."""
        self._by_identity.pop(peer.identity, None)
        self._by_key.pop(peer.key, None)
        if peer.ledger.unused and self._ledgers.get(peer.key) is peer.ledger:
            del self._ledgers[peer.key]

    def drop_silent(self, now: float, silence_s: float) -> list[Peer]:
        """Forget the peers that were not heard of for so long, and return them."""
        silent = [p for p in self._by_key.values() if now - p.last_seen > silence_s]
        for peer in silent:
            self.leave(peer)
        return silent

    def state(self) -> dict[str, dict[str, int | str]]:
        """Last incarnation, its process and its last inserted batch, of each index."""
        return {
            f"{role}/{index}": {
                "incarnation": ledger.incarnation,
                "sequence": ledger.inserted,
                **({"process": ledger.process} if ledger.process else {}),
                **({"owner": ledger.owner} if ledger.owner else {}),
            }
            for (role, index), ledger in sorted(self._ledgers.items())
        }

    def load_state(self, state: Mapping[str, Mapping[str, int | str]], now: float) -> None:
        """Take a checkpoint's ledgers, whose indices wait for workers; RunError if malformed."""
        self._ledgers = {_key(name): _ledger(name, entry) for name, entry in state.items()}
        self._reserved_until = now + self._grace_s

    def recover(
        self,
        key: Key,
        incarnation: int,
        sequence: int,
        now: float,
        process: str = "",
        owner: str = "",
    ) -> bool:
        """Note a batch of the journal as inserted; False if the table has it already."""
        ledger = self._ledgers.get(key)
        if ledger is None or incarnation > ledger.incarnation:
            ledger = self._ledgers[key] = Ledger(incarnation, process=process, owner=owner)
        known = self._recovered.get((key, incarnation), 0)
        # A process that was taken over may have had a batch here that was not inserted yet, so that
        # the checkpoint has it not: what is read here was journalled after it.
        if sequence <= (known if incarnation < ledger.incarnation else ledger.received):
            return False
        self._recovered[key, incarnation] = sequence
        if incarnation == ledger.incarnation:
            ledger.consume(sequence)
        self._reserved_until = now + self._grace_s
        return True

    def _warn_early(self) -> None:
        """Once, before anybody must be refused."""
        taken, most = len(self._by_key), self._room.peers
        if not self._crowded and taken >= CROWDED * most:
            self._crowded = True
            fields = {"event": "crowded", "count": taken}
            text = "%d processes take part, of at most %d %s"
            log.warning(text, taken, most, self._room.bound, extra=fields)

    def _check_settings(self, hello: Hello) -> None:
        ours, theirs = self._fingerprints, hello.fingerprints
        odd = sorted(n for n in ours.keys() | theirs.keys() if ours.get(n) != theirs.get(n))
        if not odd:
            return
        listed = ", ".join(odd)
        digests = (
            f"{n}: the worker has {theirs.get(n, 'none')}, the master {ours.get(n, 'none')}"
            for n in odd
        )
        reason = (
            f"its settings of {listed} differ from the master's ({'; '.join(digests)}): leave them "
            "out, for connect=RUN_DIR brings the master's, or start both with the same overrides "
            f"of {listed}"
        )
        raise RefusedError("refused_settings", Refused(reason))

    def _free_index(self, role: str, now: float, owner: str) -> int:
        reserved = self._ledgers if now < self._reserved_until else {}
        for index in range(MAX_INDEX + 1):
            key = (role, index)
            own = key not in self._ledgers or self._ledgers[key].is_of(owner)
            if own and key not in self._by_key and key not in reserved:
                return index
        reason = f"all {MAX_INDEX + 1} indices of role {role} are taken"
        raise RefusedError("refused_full", Refused(reason, later=True))

    def _open_ledger(self, key: Key, hello: Hello, owner: str) -> Ledger:
        last = self._ledgers.get(key)
        known = 0 if last is None else last.incarnation
        if last is None or hello.incarnation == 0 or hello.incarnation > known:
            if known == MAX_COUNT:
                reason = f"{key[0]} {key[1]} has no incarnation left: start with another index"
                raise RefusedError("refused_full", Refused(reason))
            # Nothing is known of what a new process has sent, nor of a forgotten incarnation.
            received = hello.first - 1 if hello.incarnation else 0
            ledger = Ledger(known + 1, received, unused=last is None or last.unused)
        elif hello.incarnation < known or last.process not in ("", hello.process):
            reason = (
                f"{key[0]} {key[1]} {TAKEN_OVER} (incarnation {known}, this is {hello.incarnation})"
            )
            raise RefusedError("superseded", Stop(reason))
        else:
            ledger = last
            # Acknowledged after the checkpoint was written, so the worker has them no more.
            self.lost_batches += ledger.skip_to(hello.first)
        ledger.process, ledger.owner = hello.process, owner
        self._ledgers[key] = ledger
        return ledger


class Askers:
    """Those who were told how the run stands a moment ago; they need not take part."""

    def __init__(self) -> None:
        self._told = dict[bytes, float]()  # connection -> when, oldest first

    def may_have(self, identity: bytes, now: float) -> bool:
        """Whether to tell a connection now; what it does not read stays in memory here."""
        while self._told and now - next(iter(self._told.values())) >= STATUS_AGAIN_S:
            del self._told[next(iter(self._told))]
        if identity in self._told or len(self._told) >= STATUS_ANSWERS:
            return False
        self._told[identity] = now
        return True


def _key(name: str) -> Key:
    role, _, index = name.partition("/")
    if role not in ROLES or not index.isdecimal() or int(index) > MAX_INDEX:
        raise RunError(f"the checkpoint's table of workers has the unknown key '{name}'")
    return role, int(index)


def _ledger(name: str, entry: object) -> Ledger:
    found = entry if isinstance(entry, dict) else {}
    incarnation, sequence = found.get("incarnation"), found.get("sequence")
    for value, low in ((incarnation, 1), (sequence, 0)):
        if type(value) is not int or not low <= value <= MAX_COUNT:
            raise RunError(
                f"the checkpoint's entry of {name} must hold an incarnation from 1 and a sequence "
                f"from 0, both to {MAX_COUNT}, got {entry!r}"
            )
    process, owner = (
        one if isinstance(one, str) and len(one) <= MAX_ID else ""
        for one in (found.get("process"), found.get("owner"))
    )
    return Ledger(int(incarnation or 0), int(sequence or 0), process, owner)
