"""The registry of peers: their indices, incarnations and connections, without sockets.

Each role has its own indices. A new process with an index gets the next incarnation and replaces
the older process. A process that reconnects after a restart of the master keeps its incarnation. If
the master has lost that number (in a power cut), the process gets the next one. A process can keep
only an incarnation that a master gave. An index stays with the first key that had it: no other key
may continue its batches or start there again.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from master.hub.gate import AMPLE, Room
from master.record.delivery import EpisodesArrived, Ledger
from tangram_core.errors import RunError, TangramError
from tangram_core.wire.messages import MAX_ID, MAX_INDEX, ROLES, TAKEN_OVER, Hello, Refused, Stop
from tangram_core.wire.schema import MAX_COUNT

# Pause before weights are sent again to a peer that has not shown them; doubled each time.
WEIGHTS_AGAIN_S = 10.0
# Most status answers to one key in STATUS_AGAIN_S; one connection gets one in that time.
STATUS_ANSWERS, STATUS_AGAIN_S = 64, 0.5
ANOTHER_KEY = "takes part with another key: leave index out, or choose another"
OWN = ("", *ROLES)  # names of the run's own keys, and of no key
Key = tuple[str, int]


class RefusedError(TangramError):
    """A process may not take part; holds the name of the counter and the answer to send."""

    def __init__(self, counter: str, answer: Refused | Stop) -> None:
        super().__init__(answer.reason)
        self.counter, self.answer = counter, answer


def another_key(name: str, hello: Hello) -> RefusedError:
    """The error for a process whose index belongs to another key.

    One that had the index before lost it while this master was down; it joins again without it.
    """
    if hello.incarnation:
        return RefusedError("superseded", Stop(f"{name} {TAKEN_OVER}"))
    return RefusedError("refused_keys", Refused(f"{name} {ANOTHER_KEY}"))


@dataclass(eq=False)
class Peer:
    """A process that takes part: a player or an evaluator.

    Attributes:
        role, index: its place in the run.
        incarnation: counts the processes that had this index, from 1.
        process: random id of the process.
        identity: ZeroMQ's name of its connection.
        last_seen: monotonic time of its last message in seconds.
        stats: numbers of the last heartbeat.
        weights_version: version of the weights that played its last batch; -1 before.
        batches, episodes, transitions: numbers inserted since the process joined.
        damaged: number of damaged messages in a row.
        holder: name of the key that it joined with; empty if the run has no keys.
        address: its network address; None before it has joined.
        weights: version last sent on request, and the time before which requests that do not show
            this version are ignored.
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
        """Whether to send weights `version` to a peer that has version `shown`; if so, notes it.

        Requests are limited because messages to a peer that does not read stay in memory here.
        """
        sent, due = self.weights
        if shown < sent and self.last_seen < due:
            return False
        self._patience_s = WEIGHTS_AGAIN_S if shown >= sent else 2.0 * self._patience_s
        self.weights = version, self.last_seen + self._patience_s
        return True

    def inserted(self, arrival: EpisodesArrived) -> None:
        """Count an inserted batch of this peer."""
        self.batches += 1
        self.episodes += arrival.episodes.count
        self.transitions += arrival.episodes.transitions

    @property
    def key(self) -> Key:
        """Role and index."""
        return self.role, self.index

    @property
    def name(self) -> str:
        """Role and index as text for messages, such as `player 3`."""
        return f"{self.role} {self.index}"


class Registry:
    """The peers by connection and by index, and the ledger of batches of each index.

    After a restart of the master, each index stays reserved for its worker for `grace_s` seconds.

    Attributes:
        lost_batches: number of acknowledged batches that neither the run nor their worker has.
    """

    def __init__(self, fingerprints: Mapping[str, str], grace_s: float, room: Room = AMPLE) -> None:
        self._room = room
        self.lost_batches = 0
        self._fingerprints = fingerprints
        self._grace_s, self._reserved_until = grace_s, 0.0
        self._by_identity: dict[bytes, Peer] = {}
        self._by_key: dict[Key, Peer] = {}
        self._ledgers: dict[Key, Ledger] = {}
        self._recovered = dict[tuple[Key, int], int]()  # last batch of each incarnation

    @property
    def peers(self) -> list[Peer]:
        """The connected peers, sorted by role and index."""
        return [self._by_key[key] for key in sorted(self._by_key)]

    def __len__(self) -> int:
        """Number of connected peers."""
        return len(self._by_key)

    def count(self, role: str) -> int:
        """Number of connected peers with a role."""
        return sum(one == role for one, _ in self._by_key)

    def has_own(self, role: str) -> bool:
        """Whether a peer with this role has one of the run's own keys."""
        return any(one.role == role and one.holder in OWN for one in self._by_key.values())

    def find(self, identity: bytes) -> Peer | None:
        """The peer of a connection, or None."""
        return self._by_identity.get(identity)

    def at(self, key: Key) -> Peer | None:
        """The peer with this role and index, or None."""
        return self._by_key.get(key)

    def ledger(self, key: Key, incarnation: int) -> Ledger | None:
        """The ledger of an incarnation; None if the index has a newer incarnation."""
        ledger = self._ledgers.get(key)
        return ledger if ledger is not None and ledger.incarnation == incarnation else None

    def admit(
        self, identity: bytes, hello: Hello, now: float, owner: str = ""
    ) -> tuple[Peer, Peer | None]:
        """Admit a process; a new process replaces an older one with the same index.

        Args:
            identity: of the connection.
            hello: message of the process.
            now: monotonic time in seconds.
            owner: name of the process's key.

        Returns:
            The peer, and the older peer that had the index, or None.

        Raises:
            RefusedError: the settings differ, there are too many peers, or the index belongs to a
                newer incarnation or to another key.
        """
        self._check_settings(hello)
        same = next((p for p in self._by_key.values() if p.process == hello.process), None)
        if same is not None and 0 < hello.incarnation < same.incarnation:
            self.leave(same)  # this HELLO is of an earlier life: may that one go on?
        elif same is not None and same.role == hello.role:
            # The process repeats its HELLO: WELCOME was late, or the connection is new.
            self._by_identity.pop(same.identity, None)
            if identity in self._by_identity:
                self.leave(self._by_identity[identity])
            same.identity, same.last_seen = identity, now
            self._by_identity[identity] = same
            # Numbers may be missing that a master refused for good before it was killed.
            self.lost_batches += same.ledger.skip_to(hello.first)
            return same, None
        # A process that takes an index over needs no extra room: the older process leaves.
        takes_over = (hello.role, hello.index) in self._by_key
        if len(self._by_key) >= self._room.peers and not takes_over:
            reason = f"{self._room.peers} processes take part, the most {self._room.bound}"
            raise RefusedError("refused_full", Refused(reason, later=True))
        stranger = self._by_identity.get(identity)
        if stranger is not None:
            self.leave(stranger)
        index = hello.index if hello.index >= 0 else self._free_index(hello.role, now, owner)
        key = (hello.role, index)
        # The run's own workers (keys in ROLES) may take their index back from any other key.
        if key in self._ledgers and not self._ledgers[key].is_of(owner) and owner not in ROLES:
            raise another_key(f"{hello.role} {index}", hello)
        ledger = self._open_ledger(key, hello, owner)
        older = self._by_key.get(key)
        if older is not None:
            self.leave(older)
        peer = Peer(hello.role, index, ledger.incarnation, hello.process, identity, now, ledger)
        self._by_identity[identity] = self._by_key[key] = peer
        return peer, older

    def leave(self, peer: Peer) -> None:
        """Remove a peer; keep the ledger if a batch of the index was ever accepted."""
        self._by_identity.pop(peer.identity, None)
        self._by_key.pop(peer.key, None)
        if peer.ledger.unused and self._ledgers.get(peer.key) is peer.ledger:
            del self._ledgers[peer.key]

    def free_all_but(self, names: Collection[str]) -> None:
        """Free the indices of all keys but these; the incarnations still count up."""
        for ledger in self._ledgers.values():
            if ledger.owner not in names:
                ledger.owner = ""

    def retire(self, key: Key, incarnation: int) -> None:
        """Let nobody go on with an incarnation whose batches were dropped."""
        if self.ledger(key, incarnation) is not None:
            if key in self._by_key:
                self.leave(self._by_key[key])
            self._ledgers[key] = Ledger(incarnation + 1)

    def drop_silent(self, now: float, silence_s: float) -> list[Peer]:
        """Remove and return the peers that sent no message for `silence_s` seconds."""
        silent = [p for p in self._by_key.values() if now - p.last_seen > silence_s]
        for peer in silent:
            self.leave(peer)
        return silent

    def state(self) -> dict[str, dict[str, int | str]]:
        """For each index: last incarnation, last inserted batch, process and key."""
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
        """Load a checkpoint's ledgers and reserve their indices; RunError if malformed."""
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
        """Register a batch of the journal as inserted; False if it is a duplicate."""
        ledger = self._ledgers.get(key)
        # The process in the checkpoint left without a batch, and its number was given again.
        if (
            ledger is None
            or incarnation > ledger.incarnation
            or (incarnation == ledger.incarnation and not ledger.may_be_of(process))
        ):
            ledger = self._ledgers[key] = Ledger(incarnation, process=process, owner=owner)
        known = self._recovered.get((key, incarnation), 0)
        # A batch of an older incarnation may have waited here when the checkpoint was written. The
        # batches read here were journalled after that, so this one is not in the checkpoint.
        if sequence <= (known if incarnation < ledger.incarnation else ledger.received):
            return False
        self._recovered[key, incarnation] = sequence
        if incarnation == ledger.incarnation:
            ledger.consume(sequence)
        self._reserved_until = now + self._grace_s
        return True

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
            "out, since connect=RUN_DIR loads the master's, or start both with the same overrides "
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
            # For a new process, numbers start at 1; for a lost incarnation, at the worker's first.
            received = hello.first - 1 if hello.incarnation else 0
            ledger = Ledger(known + 1, received, unused=last is None or last.unused)
        elif hello.incarnation < known or not last.may_be_of(hello.process):
            reason = (
                f"{key[0]} {key[1]} {TAKEN_OVER} (incarnation {known}, this is {hello.incarnation})"
            )
            raise RefusedError("superseded", Stop(reason))
        else:
            ledger = last
            # Batches acknowledged after the checkpoint: the worker has deleted them.
            self.lost_batches += ledger.skip_to(hello.first)
        ledger.process, ledger.owner = hello.process, owner
        self._ledgers[key] = ledger
        return ledger


class Askers:
    """Limits how often the status is sent to processes that ask; they need not be peers."""

    def __init__(self) -> None:
        self._told = dict[bytes, float]()  # connection -> when, oldest first

    def may_have(self, identity: bytes, now: float) -> bool:
        """Whether to answer a connection now, which counts as an answer; False if too many."""
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
