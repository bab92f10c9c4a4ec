"""Delivery: what arrives, which batches of one incarnation were seen, what to do with the next.

A worker numbers its batches from 1 within an incarnation, sends them in order, and again until they
are acknowledged. So one integer tells old from new, and with the incarnation it is all that a
checkpoint must keep for exactly-once inserts.

A batch is done with in one of two ways. It was inserted, and is acknowledged. Or it came intact and
its content is wrong: it is consumed, and refused for good, for it would be as wrong when it came
again, and a broken worker must not send it for ever. A message that was damaged on its way is
neither: nothing in it is believed, its number least of all, and what was meant comes again.
"""

import math
from collections import Counter, OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

from tangram_core.spec import Episodes
from tangram_core.wire.messages import Ack, EpisodeBatch, Reject, Scores

REMEMBERED_VERSIONS = 4096
# Of one key: peers that have left and whose batches still wait, and bytes of all that wait.
SPARE_PEERS, MAX_BYTES = 64, 512 * 2**20
MAX_EVALUATORS = 16  # that score the same weights


@dataclass(frozen=True, eq=False)
class EpisodesArrived:
    """A new batch of a sender that waits for its insert; its arrays are read-only.

    The frames are as they came, for the journal.
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
        """Of the weights that played it."""
        return self.batch.weights_version

    @property
    def episodes(self) -> Episodes:
        """What was played."""
        return self.batch.episodes


@dataclass(frozen=True, eq=False)
class ScoresArrived:
    """Results of an evaluator."""

    index: int
    incarnation: int
    scores: Scores


Arrival = EpisodesArrived | ScoresArrived


class Verdict(Enum):
    """What to do with a batch; the values name the counters.

    NEW: insert it. HELD: it came before and is not inserted yet. INSERTED: it was inserted before.
    GAP: one before it is missing. EXCESS: too many are unacknowledged.
    """

    NEW = "new"
    HELD = "held_duplicates"
    INSERTED = "duplicates"
    GAP = "gaps"
    EXCESS = "over_window"


@dataclass(eq=False)
class Ledger:
    """Batches of one incarnation; it outlives connections.

    Attributes:
        incarnation: whose batches these are.
        received: number of the last batch that was taken or finally refused.
        process: random id of the process, empty where it is not known. Two may name one
            incarnation: what was given before a kill and had no batch is given again after it.
        owner: name of the key that opened it, and whose it stays; empty where there are none.
        held: taken, not inserted yet.
        unused: no batch of this index was ever taken, in this incarnation or before.
    """

    incarnation: int
    received: int = 0
    process: str = ""
    owner: str = ""
    held: set[int] = field(default_factory=set)
    unused: bool = False

    def is_of(self, owner: str) -> bool:
        """Whether it is a key's own, or there are no keys."""
        return not self.owner or owner in ("", self.owner)

    @property
    def inserted(self) -> int:
        """Number of the last batch up to which nothing is held."""
        return min(self.held, default=self.received + 1) - 1

    def judge(self, sequence: int, window: int) -> Verdict:
        """What to do with a batch of this number, when at most `window` may be held."""
        if sequence <= self.received:
            return Verdict.HELD if sequence in self.held else Verdict.INSERTED
        if sequence > self.received + 1:
            return Verdict.GAP
        return Verdict.EXCESS if len(self.held) >= window else Verdict.NEW

    def answer(self, verdict: Verdict, sequence: int) -> Ack | Reject | None:
        """What the worker is told of a batch that is not inserted now."""
        if verdict is Verdict.INSERTED:
            return Ack(sequence, duplicate=True)
        if verdict is Verdict.GAP:
            why = f"batch {self.received + 1} must come first"
        elif verdict is Verdict.EXCESS:
            why = f"{len(self.held)} batches are unacknowledged, the most there may be"
        else:
            return None  # acknowledged after its insert
        return Reject(reason=f"batch {sequence}: {why}", sequence=sequence, final=False)

    def take(self, sequence: int, window: int) -> Verdict:
        """What to do with a batch of this number; the next one is held until its insert."""
        verdict = self.judge(sequence, window)
        if verdict is Verdict.NEW:
            self.consume(sequence)
            self.held.add(sequence)
        return verdict

    def release(self, sequence: int) -> bool:
        """A batch that was taken is inserted now; False if it was not held."""
        held = sequence in self.held
        self.held.discard(sequence)
        return held

    def consume(self, sequence: int) -> None:
        """The next batch is refused for good: it counts as done, without an insert."""
        self.received, self.unused = sequence, False

    def skip_to(self, sequence: int) -> int:
        """Go on at this number; returns how many batches before it were never received."""
        missing = max(0, sequence - 1 - self.received)
        self.received += missing
        return missing


class Waiting:
    """Batches that wait for their insert, of all processes that have an index one after another.

    At most a window of one index, and `MAX_BYTES` of one key.
    """

    def __init__(self, window: int, lockstep: bool = False) -> None:
        """Nothing waits. In lockstep a whole round must fit, which orders bound."""
        self._window, self._of = window, Counter[tuple[str, int]]()
        self._most_bytes = math.inf if lockstep else MAX_BYTES
        self._batches, self._bytes = Counter[str](), Counter[str]()  # of a key

    def add(self, arrival: EpisodesArrived) -> None:
        """One more."""
        self._count(arrival, 1)

    def done(self, arrival: EpisodesArrived) -> None:
        """One less."""
        self._count(arrival, -1)

    def room(self, key: tuple[str, int], ledger: Ledger, peers: int) -> int:
        """How many of a process may be held, while so many peers take part."""
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
            del self._of[key]  # indices come and go


class Exams:
    """Which weights were published in this life of the master, and who has scored them."""

    def __init__(self) -> None:
        self._scored = OrderedDict[int, set[int]]()  # version -> indices

    def published(self, version: int) -> None:
        """From now on these may be scored, once by each evaluator."""
        self._scored.setdefault(version, set())
        while len(self._scored) > REMEMBERED_VERSIONS:
            self._scored.popitem(last=False)

    def take(self, version: int, index: int) -> str:
        """Note that an evaluator scored these weights; why that is too much, or empty."""
        scored = self._scored.get(version)
        if scored is None:
            return f"weights {version} are none of the last {REMEMBERED_VERSIONS:,} of this master"
        if index in scored:
            return f"it has scored weights {version} before"
        if len(scored) >= MAX_EVALUATORS:
            return f"{MAX_EVALUATORS} evaluators have scored weights {version}, the most that may"
        scored.add(index)
        return ""
