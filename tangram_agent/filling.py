"""Filling an outline token by token: what is left of it, what may be laid next, and what then is.

Nothing here is learned: tokens may lie where the search of `tangram_sim.dissections` has them, and
an action takes one there exactly. Outlines that were traced in pictures may be wrong: in these they
lie where `tangram_sim.loose` has them. What is learned is which of these states can be filled.

Legend: K tokens, V corners, G rows of an outline, N corners of what is left, S different shapes.
"""

from dataclasses import dataclass

import numpy as np
import shapely

from tangram_agent.types import Flags
from tangram_sim.areas import Area, opened, overlap, rings
from tangram_sim.arrays import AnyArray, Bools, Ints, Singles
from tangram_sim.dissections import (
    Budget,
    Place,
    Search,
    Tokens,
    less,
    without,
)
from tangram_sim.geometry import outlines
from tangram_sim.layout import Layout
from tangram_sim.loose import LoosePlace, LoosePlaces
from tangram_sim.rings import as_area, covered_area

TOLERANCE = 0.004  # of the root of all tokens' area, see `Search`
LOOSE = 0.035  # of it, see `LoosePlaces`
SOLVED = 0.95  # IoU from which an outline that was traced counts as filled
MOST_PLACES = 8  # that are learned from, of a state
UNUSED = 255  # part of a row that holds no corner
_INSIDE = 0.9  # share of a laid token that lies in the outline
_LOOSELY = 0.5  # the same, where the outline may be wrong
_OWN = 0.8  # IoU of tokens and what others leave of the outline that was traced of all of them


@dataclass(frozen=True, eq=False)
class Rests:
    """What is left to fill, of n states, as their corners see it.

    In units of the root of all tokens' area, from the middle of what is left, its longest side
    along the x axis: so a figure looks the same wherever it lies.

    Attributes:
        points: (n, N, 2) corners, ring after ring.
        follow: (n, N) which corner is next on its ring.
        part: (n, N) to which part it belongs, `UNUSED` where there is none.
        left: (n, S) tokens that are left of each shape.
    """

    points: Singles
    follow: Flags
    part: Flags
    left: Flags

    def __len__(self) -> int:
        return len(self.points)

    @property
    def known(self) -> Bools:
        """(n,) states that have corners, and no more than are seen."""
        return np.asarray((self.part != UNUSED).any(axis=1))

    @staticmethod
    def empty(count: int, corners: int, shapes: int) -> "Rests":
        """States of no corners."""
        return Rests(
            np.zeros((count, corners, 2), np.float32),
            np.tile(np.arange(corners, dtype=np.uint8), (count, 1)),
            np.full((count, corners), UNUSED, np.uint8),
            np.zeros((count, shapes), np.uint8),
        )

    @staticmethod
    def joined(every: list["Rests"]) -> "Rests":
        """States one after the other."""
        return Rests(*(np.concatenate(parts) for parts in zip(*map(_parts, every), strict=True)))

    def turned(self, generator: np.random.Generator) -> "Rests":
        """The same states, each turned by some eighths and half of them seen in a mirror.

        That changes nothing of what fills them where tokens may be turned over.
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
        """Some of the states."""
        return Rests(*(part[rows] for part in _parts(self)))


def _parts(rests: Rests) -> tuple[AnyArray, ...]:
    return rests.points, rests.follow, rests.part, rests.left


class Filling:
    """The game of one set of tokens.

    Attributes:
        tokens: K.
        corners: N.
        shapes: S.
    """

    def __init__(self, layout: Layout, traced: bool = False) -> None:
        """The game of a layout's tokens.

        Args:
            layout: the tokens.
            traced: whether outlines were traced in pictures, and may be wrong.
        """
        self._layout, self._tokens, self._traced = layout, Tokens(layout), traced
        self._tolerance = (LOOSE if traced else TOLERANCE) * self._tokens.unit
        self._straight = TOLERANCE * self._tokens.unit
        self._search = Search(self._tokens, self._tolerance, Budget(np.inf))
        self._loose = LoosePlaces(self._tokens, self._tolerance)
        self._open = (1.0 - SOLVED) * self._tokens.unit**2  # area that may be left open
        self._shape: Ints = np.zeros(layout.tokens, np.int64)
        for shape, tokens in enumerate(self._tokens.own):
            self._shape[list(tokens)] = shape
        self.tokens, self.shapes = layout.tokens, len(self._tokens.own)
        self.corners = layout.corner_count + layout.tokens

    def shape_of(self, token: int) -> int:
        """The number of a token's shape."""
        return int(self._shape[token])

    def tokens_of(self, shape: int) -> tuple[int, ...]:
        """The tokens of a shape."""
        return self._tokens.own[shape]

    def left(self, tokens: Bools) -> tuple[int, ...]:
        """How many of each shape there are among tokens (K,)."""
        return tuple(np.bincount(self._shape[tokens], minlength=self.shapes).tolist())

    def inside(self, corners: AnyArray, outline: AnyArray) -> Bools:
        """(K,) tokens with corners (V, 2) that lie in an outline (G, 2), all but for a little."""
        area = as_area(outline)
        own = outlines(np.asarray(corners, np.float64)[None], self._layout)[0]
        shared = shapely.area(shapely.intersection(shapely.polygons(own), area))
        return np.asarray(shared >= (_LOOSELY if self._traced else _INSIDE) * self._layout.areas)

    def rest(self, outline: AnyArray, corners: AnyArray, laid: Bools) -> Area:
        """What laid tokens (K,), with all tokens' corners (V, 2), leave of an outline (G, 2)."""
        area = as_area(outline)
        if not laid.any():
            return area
        covered = covered_area(np.asarray(corners), self._layout, laid)
        return without(area, covered, self._tolerance, self._tokens.unit)

    def hindsight(self, corners: AnyArray, tokens: Bools, outline: AnyArray | None) -> Rests | None:
        """What tokens (K,) came to cover, as something that they fill; None if they lie on others.

        Args:
            corners: (V, 2) of all tokens.
            tokens: some of them.
            outline: (G, 2) of all tokens as it was traced, where that is what is seen.
        """
        covered = covered_area(np.asarray(corners), self._layout, tokens)
        if outline is None:
            own = opened(covered, self._tolerance)
            fills = self._search.fits(own, self.left(tokens))
        else:
            own = self.rest(outline, corners, ~tokens)
            fills = self._apart(covered, tokens) and overlap(own, covered) >= _OWN
        seen = self.seen(own, self.left(tokens))
        return seen if fills and bool(seen.known.all()) else None

    def _apart(self, covered: Area, tokens: Bools) -> bool:
        """Whether what tokens (K,) cover is as much as they can, all but for a little."""
        return bool(covered.area >= SOLVED * self._layout.areas[tokens].sum())

    def solved(self, outline: AnyArray, corners: AnyArray, laid: Bools) -> bool:
        """Whether laid tokens (K,), all of them, fill an outline (G, 2)."""
        if not laid.all():
            return False
        if self._traced:
            covered = covered_area(np.asarray(corners), self._layout)
            return self._apart(covered, laid) and overlap(as_area(outline), covered) >= SOLVED
        return self._search.fits(self.rest(outline, corners, laid), self.left(~laid))

    def places(self, rest: Area, left: tuple[int, ...]) -> list[Place]:
        """What may be laid next, see `Search.places`; also what need not fit, see `LoosePlaces`."""
        if self._traced:
            return [self._place(rest, left, one) for one in self._loose(rest, left)]
        return self._search.places(rest, left)

    def _place(self, rest: Area, left: tuple[int, ...], one: LoosePlace) -> Place:
        """A place and what comes of it; a last token that leaves too much open leads nowhere."""
        now = less(left, one.laid)
        gone = without(rest, one.polygon, self._tolerance, self._tokens.unit)
        last = not any(now)
        filled = last and shapely.difference(rest, one.polygon).area <= self._open
        cost = one.over / float(self._tokens.areas.min())
        return Place(one.laid, gone, now, filled, dead=last and not filled, cost=cost)

    def seen(self, rest: Area, left: tuple[int, ...]) -> Rests:
        """One state; empty where it has too many corners."""
        found = Rests.empty(1, self.corners, self.shapes)
        found.left[0] = left
        every = rings(rest, self._straight)
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
