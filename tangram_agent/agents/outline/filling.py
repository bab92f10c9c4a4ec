"""Filling an outline token by token: its rest, the possible next places, and the next states.

Nothing here is learned. The search of `tangram_sim.geometry.dissections` finds the places, and an
action takes a token there exactly. The network learns which of the next states can be filled. The
rest of an outline is the part that no laid token covers.

Legend: K tokens, V corners, G rows of an outline, N corners of a rest, S different shapes.
"""

from dataclasses import dataclass

import numpy as np
import shapely

from tangram_agent.base.types import Flags
from tangram_core.arrays import AnyArray, Bools, Ints, Singles
from tangram_sim.geometry.areas import Area, opened, rings
from tangram_sim.geometry.dissections import Budget, Place, Search, Tokens, without
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines
from tangram_sim.geometry.rings import as_area, covered_area

TOLERANCE = 0.004  # share of the root of all tokens' area, see `Search`
MOST_PLACES = 8  # places of a state that are learned from
UNUSED = 255  # part of a row that holds no corner
_INSIDE = 0.9  # share of a laid token that lies in the outline


@dataclass(frozen=True, eq=False)
class Rests:
    """Network inputs of n states: the corners of their rests, and the tokens that are left.

    The unit is the root of all tokens' area. The origin is the middle of the rest, and its longest
    side lies along the x axis. So a figure looks the same wherever it lies.

    Attributes:
        points: (n, N, 2) corners, ring after ring.
        follow: (n, N) index of the next corner on the same ring.
        part: (n, N) number of the corner's part of the rest; `UNUSED` without a corner.
        left: (n, S) how many tokens of each shape are left.
    """

    points: Singles
    follow: Flags
    part: Flags
    left: Flags

    def __len__(self) -> int:
        return len(self.points)

    @property
    def known(self) -> Bools:
        """(n,) whether a state has corners, and at most N."""
        return np.asarray((self.part != UNUSED).any(axis=1))

    @staticmethod
    def empty(count: tuple[int, ...], corners: int, shapes: int) -> "Rests":
        """States without corners."""
        return Rests(
            np.zeros((*count, corners, 2), np.float32),
            np.tile(np.arange(corners, dtype=np.uint8), (*count, 1)),
            np.full((*count, corners), UNUSED, np.uint8),
            np.zeros((*count, shapes), np.uint8),
        )

    @staticmethod
    def joined(every: list["Rests"]) -> "Rests":
        """Concatenate groups of states."""
        columns = zip(*(vars(one).values() for one in every), strict=True)
        return Rests(*map(np.concatenate, columns))

    def turned(self, generator: np.random.Generator) -> "Rests":
        """The states, each turned by random eighths of a circle, and half of them mirrored.

        The same tokens still fill them if tokens may be turned over.
        """
        count = len(self)
        z = self.points @ np.array([1.0, 1.0j], np.complex64)
        z *= np.exp(0.25j * np.pi * generator.integers(8, size=(count, 1)))
        mirrored = generator.random(count) < 0.5
        z = np.where(mirrored[:, None], z.conj(), z)
        points = np.stack([z.real, z.imag], axis=-1).astype(np.float32)
        before = np.argsort(self.follow, axis=1).astype(np.uint8)
        follow = np.where(mirrored[:, None], before, self.follow)
        return Rests(points, follow, self.part, self.left)

    def at(self, rows: Ints | Bools | slice) -> "Rests":
        """The states in the given rows."""
        return Rests(*(part[rows] for part in vars(self).values()))

    @property
    def flat(self) -> "Rests":
        """States (n, M) as n * M single states."""
        return Rests(*(part.reshape(-1, *part.shape[2:]) for part in vars(self).values()))


class Filling:
    """Rules for filling outlines with one set of tokens.

    Attributes:
        tokens: K, number of tokens.
        corners: N, most corners of a rest.
        shapes: S, number of different shapes.
        shape_of: (K,) the number of each token's shape.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout, self._tokens = layout, Tokens(layout)
        self._tolerance = TOLERANCE * self._tokens.unit
        self._search = Search(self._tokens, self._tolerance, Budget(np.inf))
        self.shape_of: Ints = np.zeros(layout.tokens, np.int64)
        for shape, tokens in enumerate(self._tokens.own):
            self.shape_of[list(tokens)] = shape
        self.tokens, self.shapes = layout.tokens, len(self._tokens.own)
        self.corners = layout.corner_count + layout.tokens

    def left(self, tokens: Bools) -> tuple[int, ...]:
        """How many of the marked tokens (K,) have each shape."""
        return tuple(np.bincount(self.shape_of[tokens], minlength=self.shapes).tolist())

    def inside(self, corners: AnyArray, outline: AnyArray) -> Bools:
        """(K,) whether at least 90 % of each token, by corners (V, 2), is in the outline (G, 2)."""
        area = as_area(outline)
        own = outlines(np.asarray(corners, np.float64)[None], self._layout)[0]
        shared = shapely.area(shapely.intersection(shapely.polygons(own), area))
        return np.asarray(shared >= _INSIDE * self._layout.areas)

    def rest(self, outline: AnyArray, corners: AnyArray, laid: Bools) -> Area:
        """The rest of an outline (G, 2) with laid tokens (K,), from all tokens' corners (V, 2)."""
        area = as_area(outline)
        if not laid.any():
            return area
        covered = covered_area(np.asarray(corners), self._layout, laid)
        return without(area, covered, self._tolerance, self._tokens.unit)

    def hindsight(self, corners: AnyArray, tokens: Bools) -> Rests | None:
        """The area that some tokens cover, as a state that they fill; None if they overlap.

        Args:
            corners: (V, 2) of all tokens.
            tokens: (K,) which tokens.
        """
        covered = covered_area(np.asarray(corners), self._layout, tokens)
        own, left = opened(covered, self._tolerance), self.left(tokens)
        seen = self.seen(own, left)
        return seen if self._search.fits(own, left) and bool(seen.known.all()) else None

    def solved(self, outline: AnyArray, corners: AnyArray, laid: Bools) -> bool:
        """Whether all tokens are laid (K,) and fill an outline (G, 2)."""
        if not laid.all():
            return False
        return self._search.fits(self.rest(outline, corners, laid), self.left(~laid))

    def places(self, rest: Area, left: tuple[int, ...]) -> list[Place]:
        """Next places after which the rest may still be filled, see `Search.places`."""
        return [place for place in self._search.places(rest, left) if not place.dead]

    def seen(self, rest: Area, left: tuple[int, ...]) -> Rests:
        """Network input of one state; without corners if it has more than N."""
        found = Rests.empty((1,), self.corners, self.shapes)
        found.left[0] = left
        every = rings(rest, self._tolerance)
        if not every or sum(len(z) for z, _, _ in every) > self.corners:
            return found
        z = np.concatenate([ring for ring, _, _ in every])
        sides = np.concatenate([np.roll(ring, -1) - ring for ring, _, _ in every])
        along = sides[np.abs(sides).argmax()]
        middle = complex(rest.centroid.x, rest.centroid.y)
        own = (z - middle) * np.abs(along) / along / self._tokens.unit
        found.points[0, : len(z)] = np.column_stack([own.real, own.imag])
        first = 0
        for ring, part, _ in every:
            own_rows = np.arange(first, first + len(ring))
            found.follow[0, own_rows] = np.roll(own_rows, -1)
            found.part[0, own_rows] = min(part, self.corners - 1)
            first += len(ring)
        return found
