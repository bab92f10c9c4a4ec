"""Delivery of batches: which ones are new, duplicates or missing, for exactly-once inserts.

A worker numbers its batches from 1 within an incarnation. It sends them in order, and repeats them
until they are acknowledged. So one integer separates old batches from new ones. For exactly-once
inserts, a checkpoint must keep only this integer and the incarnation.

A batch is finished in one of two ways. Either it was inserted and is acknowledged. Or it arrived
intact with wrong content: then it is consumed and refused for good, because a second copy would be
just as wrong. A message that was damaged on its way is not finished. Nothing in it is trusted, not
even its number, and the worker sends the batch again.
"""

import math
from collections import Counter, OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

from tangram_core.spec import Episodes
from tangram_core.wire.messages import GAP, Ack, EpisodeBatch, Reject, Scores

REMEMBERED_VERSIONS = 4096
# Limits of one key: peers that have left but whose batches wait, and bytes of all waiting batches.
SPARE_PEERS, MAX_BYTES = 64, 512 * 2**20
MAX_EVALUATORS = 16  # of one key that may score the same weights


@dataclass(frozen=True, eq=False)
class EpisodesArrived:
    """A new batch that waits for its insert; its arrays are read-only.

    Attributes:
        role, index, incarnation, process: of the sender.
        batch: the decoded message.
        frames: the message as it arrived, for the journal.
        owner: name of the sender's key; empty if the run has no keys.
    """

    role: str
    index: int
    incarnation: int
    batch: EpisodeBatch
    frames: Sequence[bytes]
    process: str = ""
    owner: str = ""

    @property
    def sequence(self) -> int:
        """Number of the batch."""
        return self.batch.sequence

    @property
    def weights_version(self) -> int:
        """Version of the weights that played the batch."""
        return self.batch.weights_version

    @property
    def episodes(self) -> Episodes:
        """The episodes of the batch."""
        return self.batch.episodes


Arrival = EpisodesArrived | Scores


class Verdict(Enum):
    """State of a batch that arrives; the values are names of counters.

    NEW: insert it. HELD: a duplicate of a batch that waits for its insert. INSERTED: a duplicate of
    an inserted batch. GAP: the batch before it is missing. EXCESS: too many are unacknowledged.
    """

    NEW = "new"
    HELD = "held_duplicates"
    INSERTED = "duplicates"
    GAP = "gaps"
    EXCESS = "over_window"


@dataclass(eq=False)
class Ledger:
    """The batches of one incarnation; kept when the connection is lost.

    Attributes:
        incarnation: number of the incarnation.
        received: number of the last batch that was accepted or refused for good.
        process: random id of the process; empty if unknown. Two processes may claim one
            incarnation: after a kill, a number without any batch may be given again.
        owner: name of the key that had the index first; empty if the run has no keys.
        held: numbers of the batches that were accepted and are not inserted yet.
        unused: whether no batch of this index was ever accepted, in any incarnation.
    """

    incarnation: int
    received: int = 0
    process: str = ""
    owner: str = ""
    held: set[int] = field(default_factory=set)
    unused: bool = False

    def is_of(self, owner: str) -> bool:
        """Whether the ledger belongs to this key, or to no key."""
        return not self.owner or owner in ("", self.owner)

    def may_be_of(self, process: str) -> bool:
        """Whether the ledger belongs to this process, as far as is known."""
        return "" in (process, self.process) or process == self.process

    @property
    def inserted(self) -> int:
        """Number of the last batch that is finished together with all before it."""
        return min(self.held, default=self.received + 1) - 1

    def judge(self, sequence: int, window: int) -> Verdict:
        """State of a batch with this number if at most `window` batches may be held."""
        if sequence <= self.received:
            return Verdict.HELD if sequence in self.held else Verdict.INSERTED
        if sequence > self.received + 1:
            return Verdict.GAP
        return Verdict.EXCESS if len(self.held) >= window else Verdict.NEW

    def answer(self, verdict: Verdict, sequence: int) -> Ack | Reject | None:
        """Answer to the worker for a batch that is not new; None if the answer comes later."""
        if verdict is Verdict.INSERTED:
            return Ack(sequence, duplicate=True)
        if verdict is Verdict.GAP:
            why = f"batch {self.received + 1} {GAP}"
        elif verdict is Verdict.EXCESS:
            why = f"{len(self.held)} batches are unacknowledged, which is the limit"
        else:
            return None  # the batch is acknowledged after its insert
        return Reject(reason=f"batch {sequence}: {why}", sequence=sequence, final=False)

    def take(self, sequence: int, window: int) -> Verdict:
        """As `judge`; a new batch is then held until `release`."""
        verdict = self.judge(sequence, window)
        if verdict is Verdict.NEW:
            self.received, self.unused = sequence, False
            self.held.add(sequence)
        return verdict

    def release(self, sequence: int) -> bool:
        """Note that a held batch was inserted; False if it was not held."""
        held = sequence in self.held
        self.held.discard(sequence)
        return held

    def consume(self, sequence: int) -> None:
        """Count the next batch as received, because it is refused for good."""
        self.received = sequence

    def skip_to(self, sequence: int) -> int:
        """Expect this number next; returns how many batches before it were never received."""
        missing = max(0, sequence - 1 - self.received)
        self.received += missing
        return missing


class Waiting:
    """Counts the batches that wait for their insert, and limits them.

    The limits are a window for each index, whatever process has it, and `MAX_BYTES` for each key.
    """

    def __init__(self, window: int, lockstep: bool = False) -> None:
        """Begin with none. In lockstep bytes have no limit: the orders limit the batches."""
        self._window, self._of = window, Counter[tuple[str, int]]()
        self._most_bytes = math.inf if lockstep else MAX_BYTES
        self._batches, self._bytes = Counter[str](), Counter[str]()  # of a key

    def add(self, arrival: EpisodesArrived) -> None:
        """Count a batch that waits."""
        self._count(arrival, 1)

    def done(self, arrival: EpisodesArrived) -> None:
        """Remove a batch that was inserted."""
        self._count(arrival, -1)

    def room(self, key: tuple[str, int], ledger: Ledger, peers: int) -> int:
        """How many batches a process may hold, while `peers` processes take part."""
        crowd = self._batches[ledger.owner] >= self._window * (peers + SPARE_PEERS)
        if crowd or self._bytes[ledger.owner] >= self._most_bytes:
            return 0
        return self._window - self._of[key] + len(ledger.held)

    def _count(self, arrival: EpisodesArrived, sign: int) -> None:
        key, owner = (arrival.role, arrival.index), arrival.owner
        self._batches[owner] += sign
        self._bytes[owner] += sign * sum(map(len, arrival.frames))
        self._of[key] += sign
        if not self._of[key]:
            del self._of[key]  # so that the table does not grow for ever


class Exams:
    """The versions of weights that this master process published, and who has scored them."""

    def __init__(self) -> None:
        self._scored = OrderedDict[int, set[tuple[str, int]]]()  # version -> keys and indices

    def published(self, version: int) -> None:
        """Allow each evaluator to score this version once."""
        self._scored.setdefault(version, set())
        while len(self._scored) > REMEMBERED_VERSIONS:
            self._scored.popitem(last=False)

    def take(self, version: int, index: int, key: str) -> str:
        """Note that an evaluator scored a version; returns a reason to refuse that, or empty."""
        scored = self._scored.get(version)
        if scored is None:
            return (
                f"weights {version} are not among the last {REMEMBERED_VERSIONS:,} of this master"
            )
        if (key, index) in scored:
            return f"it has scored weights {version} before"
        if sum(one == key for one, _ in scored) >= MAX_EVALUATORS:
            return f"{MAX_EVALUATORS} evaluators have scored weights {version}, which is the limit"
        scored.add((key, index))
        return ""
