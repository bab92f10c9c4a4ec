"""The replay buffer of the agent for outlines: played states, and states filled in hindsight.

Hindsight needs no new goal here: the area that tokens cover is an outline that they fill. The same
holds for some of the tokens. If an episode filled its outline, all its states could be filled.
Failures teach, too: each played state is kept with the states that could have followed.

Legend: E episodes, T steps, n rows, M places, K tokens, N corners, S shapes.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields

import numpy as np
from shapely.errors import GEOSException

from tangram_agent.agents.outline.filling import MOST_PLACES, Filling, Rests
from tangram_agent.base.ring import Column, Ring
from tangram_agent.base.types import Flags
from tangram_core.arrays import Bools, Ints
from tangram_core.spec import Array, Arrays, Episodes
from tangram_sim.geometry.areas import Area
from tangram_sim.geometry.layout import Layout

OPEN, FILLED = 1, 2  # kinds of places; 0: no place, or a dead one


@dataclass(frozen=True, eq=False)
class FillBatch:
    """A batch of states.

    Attributes:
        filled: states (n,) that tokens filled.
        played: states (n',) that were played.
        places: states (n' * M) that could have followed each of them.
        ends: (n', M) OPEN, FILLED or 0 for each of `places`. The first one is FILLED, too, if the
            episode filled its outline.
    """

    filled: Rests
    played: Rests
    places: Rests
    ends: Flags

    @property
    def arrays(self) -> Arrays:
        """The arrays of the batch, by name."""
        states = _named("filled", self.filled) | _named("played", self.played)
        return states | _named("places", self.places) | {"ends": self.ends}


class FillReplay:
    """Replay buffer of played states with their next places, and of hindsight states.

    Attributes:
        capacity: most states of each kind.
    """

    def __init__(self, layout: Layout, capacity: int, copies: int) -> None:
        """Allocate all arrays at once.

        Args:
            layout: the tokens.
            capacity: most states of each kind.
            copies: hindsight states for each episode.
        """
        self.capacity, self._copies = capacity, copies
        self._filling = Filling(layout)
        ends = Column(np.zeros((capacity, MOST_PLACES), np.uint8), 0, FILLED)
        played = self._room("played") | self._room("places", MOST_PLACES) | {"ends": ends}
        self._played = Ring(played, "played")
        self._filled = Ring(self._room("filled"), "filled")

    def _room(self, name: str, *each: int) -> dict[str, Column]:
        """Empty columns, with one state in each row or a group of states."""
        corners = self._filling.corners
        empty = Rests.empty((self.capacity, *each), corners, self._filling.shapes)
        bounds = {f"{name}_follow": (0, corners - 1)}
        return {n: Column(part, *bounds.get(n, ())) for n, part in _named(name, empty).items()}

    def __len__(self) -> int:
        return min(len(self._played), len(self._filled))

    def insert(self, episodes: Episodes, generator: np.random.Generator) -> int:
        """Add the played states of episodes and their hindsight states.

        Returns:
            The number of transitions in the episodes that were added.
        """
        used = 0
        for corners, placed, goal in zip(
            episodes["corners"], episodes["placed"], episodes["goals"], strict=True
        ):
            # A faulty worker may send impossible corners: an error of the geometry library must
            # not end the run.
            with suppress(GEOSException):
                if self._insert(corners, placed.astype(np.bool_), goal, generator):
                    used += len(corners) - 1
        return used

    def _insert(
        self, corners: Array, placed: Bools, goal: Array, generator: np.random.Generator
    ) -> bool:
        """One episode: corners (T + 1, V, 2), placed (T + 1, K) and outlines (G, 2).

        Returns:
            Whether the episode was added: it must have a hindsight state.
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
                break  # from here on no token fitted
            rest = filling.rest(goal, corners[step], laid)
            self._add_played(rest, filling.left(~laid), solved)
        self._filled.append(_named("filled", Rests.joined(filled)))
        return True

    def _hindsight(self, corners: Array, own: Ints, generator: np.random.Generator) -> list[Rests]:
        """States that random subsets of tokens (n,) fill; none for subsets that overlap."""
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
        places = self._filling.places(rest, left)
        ends = np.zeros((1, MOST_PLACES), np.uint8)
        seen = [self._filling.seen(place.rest, place.left) for place in places[:MOST_PLACES]]
        for i, (place, one) in enumerate(zip(places, seen, strict=False)):
            ends[0, i] = FILLED if place.filled else OPEN * bool(one.known.all())
        if solved and places:  # any place will do: only the best one counts
            ends[0, 0] = FILLED
        more = (MOST_PLACES - len(seen),)
        none = Rests.empty(more, self._filling.corners, self._filling.shapes)
        each = _named("places", Rests.joined([*seen, none]))
        row = {name: part[None] for name, part in each.items()}
        self._played.append(_named("played", state) | row | {"ends": ends})

    def sample(self, size: int, generator: np.random.Generator) -> FillBatch:
        """`size` states, half of them from hindsight, drawn uniformly with replacement.

        Raises:
            ValueError: the buffer has no states of one kind.
        """
        played = self._played.drawn(size - size // 2, generator)
        filled = self._filled.drawn(size // 2, generator)
        return FillBatch(
            _of("filled", self._filled, filled).turned(generator),
            _of("played", self._played, played).turned(generator),
            _of("places", self._played, played).flat,
            self._played.arrays["ends"][played],
        )

    def state(self) -> dict[str, Array]:
        """The kept states and the counters, as arrays for a checkpoint (mostly views)."""
        return self._played.state() | self._filled.state()

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Load a state, see `Ring.load_state`."""
        self._played.load_state(state)
        self._filled.load_state(state)


def _named(name: str, rests: Rests) -> dict[str, Array]:
    return {f"{name}_{part}": array for part, array in vars(rests).items()}


def _of(name: str, ring: Ring, rows: Ints) -> Rests:
    return Rests(*(ring.arrays[f"{name}_{part.name}"][rows] for part in fields(Rests)))
