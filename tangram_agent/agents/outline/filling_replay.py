"""What the agent of outlines learns from: states that it played, and those that hindsight fills.

In its purest form hindsight needs no other goal: whatever tokens have come to cover is an outline
that they fill, and so is what any of them cover; and where play filled the outline, so it did all
states on the way. What went wrong teaches, too: of each state that was played the states are kept
that it could have gone on to.

Legend: E episodes, T steps, n rows, M places, K tokens, N corners, S shapes.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from shapely.errors import GEOSException

from tangram_agent.agents.outline.filling import MOST_PLACES, UNUSED, Filling, Rests
from tangram_agent.base.types import Flags
from tangram_core.arrays import Bools, Ints
from tangram_core.errors import RunError
from tangram_core.spec import Episodes
from tangram_sim.geometry.areas import Area
from tangram_sim.geometry.layout import Layout

Array = npt.NDArray[Any]
OPEN, FILLED = 1, 2  # of a place; 0: there is none, or it is dead
_COUNTERS = "counters"


@dataclass(frozen=True, eq=False)
class FillBatch:
    """States to learn from.

    Attributes:
        filled: states (n,) that tokens filled.
        played: states (n',) that were played.
        places: (n' * M) what each of them could have gone on to.
        ends: (n', M) of these OPEN, FILLED, or 0; FILLED, too, where play went on and filled all.
    """

    filled: Rests
    played: Rests
    places: Rests
    ends: Flags

    @property
    def arrays(self) -> dict[str, Array]:
        """All that it consists of, by name."""
        states = {"filled": self.filled, "played": self.played, "places": self.places}
        named = {f"{n}_{part}": one for n, own in states.items() for part, one in vars(own).items()}
        return named | {"ends": self.ends}


class FillReplay:
    """Two rings over preallocated arrays: of states that were played and of those of hindsight.

    Attributes:
        capacity: states kept of each.
    """

    def __init__(self, layout: Layout, capacity: int, copies: int) -> None:
        """Allocate everything at once.

        Args:
            layout: the tokens.
            capacity: states kept of each kind.
            copies: states of hindsight for each episode.
        """
        self.capacity, self._copies = capacity, copies
        self._filling = Filling(layout)
        size = self._filling.corners, self._filling.shapes
        self._played = Rests.empty(self.capacity, *size)
        self._places = Rests.empty(self.capacity * MOST_PLACES, *size)
        self._ends = np.zeros((self.capacity, MOST_PLACES), np.uint8)
        self._filled = Rests.empty(self.capacity, *size)
        self._added = np.zeros(2, np.int64)  # played, filled

    def __len__(self) -> int:
        return min(int(self._added.min()), self.capacity)

    def insert(self, episodes: Episodes, generator: np.random.Generator) -> int:
        """Take in episodes as they were played, and what their tokens came to cover.

        Returns:
            How many transitions there are in those that something is learned from.
        """
        used = 0
        for corners, placed, goal in zip(
            episodes["corners"], episodes["placed"], episodes["goals"], strict=True
        ):
            # Corners are no worker's invention where it plays by the rules; where not, no geometry
            # that a library trips over may end the run.
            with suppress(GEOSException):
                if self._insert(corners, placed.astype(np.bool_), goal, generator):
                    used += len(corners) - 1
        return used

    def _insert(
        self, corners: Array, placed: Bools, goal: Array, generator: np.random.Generator
    ) -> bool:
        """One episode: corners (T + 1, V, 2), placed (T + 1, K) and outlines (G, 2).

        Returns:
            Whether it was taken: hindsight has a state of it.
        """
        filling, inside = self._filling, self._filling.inside(corners[-1], goal)
        own = np.flatnonzero(placed[-1] & inside)
        filled = self._hindsight(corners[-1], own, generator)
        if not filled:
            return False
        solved = filling.solved(goal, corners[-1], placed[-1])
        for step in range(len(corners) - 1):
            laid = placed[step]
            if (laid & ~inside).any():
                break  # nothing fitted any more
            rest = filling.rest(goal, corners[step], laid)
            self._add_played(rest, filling.left(~laid), solved)
        for seen in filled:
            _put(self._filled, int(self._added[1]) % self.capacity, seen)
            self._added[1] += 1
        return True

    def _hindsight(self, corners: Array, own: Ints, generator: np.random.Generator) -> list[Rests]:
        """What some of their own tokens (n,) cover; nothing where they lie on each other."""
        filling, found = self._filling, list[Rests]()
        for _ in range(self._copies if len(own) else 0):
            chosen = np.zeros(filling.tokens, np.bool_)
            chosen[generator.permutation(own)[: generator.integers(1, len(own) + 1)]] = True
            seen = filling.hindsight(corners, chosen)
            if seen is not None:
                found.append(seen)
        return found

    def _add_played(self, rest: Area, left: tuple[int, ...], solved: bool) -> None:
        state = self._filling.seen(rest, left)
        if not state.known.all():
            return
        row = int(self._added[0]) % self.capacity
        places = [place for place in self._filling.places(rest, left) if not place.dead]
        _put(self._played, row, state)
        self._ends[row] = 0
        for i, place in enumerate(places[:MOST_PLACES]):
            seen = self._filling.seen(place.rest, place.left)
            self._ends[row, i] = FILLED if place.filled else OPEN * bool(seen.known.all())
            _put(self._places, row * MOST_PLACES + i, seen)
        if solved and places:  # no matter by which place: a state is worth its best one
            self._ends[row, 0] = FILLED
        self._added[0] += 1

    def sample(self, size: int, generator: np.random.Generator) -> FillBatch:
        """`size` states, half of them of hindsight, drawn uniformly with replacement.

        Raises:
            ValueError: there are none of one kind.
        """
        if not len(self):
            raise ValueError("cannot sample from an empty replay buffer")
        kept = np.minimum(self._added, self.capacity)
        played = generator.integers(kept[0], size=size - size // 2)
        filled = generator.integers(kept[1], size=size // 2)
        places = (played[:, None] * MOST_PLACES + np.arange(MOST_PLACES)).ravel()
        return FillBatch(
            self._filled.at(filled).turned(generator),
            self._played.at(played).turned(generator),
            self._places.at(places),
            self._ends[played],
        )

    def _columns(self) -> Iterator[tuple[str, Array, int, int]]:
        """Name, column, rows that a state takes in it, and which counter counts these."""
        for name, rests, rows, counter in (
            ("played", self._played, 1, 0),
            ("places", self._places, MOST_PLACES, 0),
            ("filled", self._filled, 1, 1),
        ):
            for part, column in vars(rests).items():
                yield f"{name}_{part}", column, rows, counter
        yield "ends", self._ends, 1, 0

    def state(self) -> dict[str, Array]:
        """The kept states and the counters, as arrays for a checkpoint (mostly views)."""
        kept = np.minimum(self._added, self.capacity)
        columns = {name: column[: kept[c] * n] for name, column, n, c in self._columns()}
        return columns | {_COUNTERS: self._added.copy()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over a state from `state()`.

        Raises:
            RunError: columns are missing, of another layout, type or capacity, or hold what no
                state has.
        """
        added = np.asarray(state.get(_COUNTERS, ()), np.int64)
        if added.shape != (2,) or (added < 0).any():
            raise RunError("replay state: no counters: not a replay of outlines")
        kept = np.minimum(added, self.capacity)
        for name, column, rows, counter in self._columns():
            part, shape = state.get(name), (int(kept[counter]) * rows, *column.shape[1:])
            if part is None or part.shape != shape or part.dtype != column.dtype:
                raise RunError(
                    f"replay state: '{name}' does not fit (expected {column.dtype} {shape}): was "
                    "the checkpoint written with other tokens or another agent.replay_capacity?"
                )
            column[: len(part)] = part
        self._added = added
        self.check_valid()

    def check_valid(self) -> None:
        """Raise RunError unless every kept number is finite and every index within its bounds."""
        for rests in (self._played, self._places, self._filled):
            used = rests.part[rests.part != UNUSED]
            if not np.isfinite(rests.points).all():
                raise RunError("replay buffer: corners that are not finite")
            if max(rests.follow.max(), used.max(initial=0)) >= self._filling.corners:
                raise RunError("replay buffer: an index beyond the corners")
        if self._ends.max() > FILLED:
            raise RunError("replay buffer: 'ends' holds what no place has")


def _put(rests: Rests, row: int, one: Rests) -> None:
    for name, column in vars(rests).items():
        column[row] = getattr(one, name)[0]
