"""An outline -> where tokens lie that fill it: a complete search, corner by corner.

At a convex corner of what is left to fill some token must have a corner of its own, with an edge
along the side that leaves it: so few places are possible, whatever the angle. The corner with the
fewest of them is filled next. What is left must consist of parts that have the areas of tokens.

Points and directions are complex numbers here. Legend: S different shapes, n candidates, C corners
of a token, filled up to those of the largest by repeating the last one.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from tangram_sim.arrays import Bools, Complex, Floats, Ints
from tangram_sim.layout import Layout
from tangram_vision.kinds import Kind, kinds_of

Area: TypeAlias = "Polygon | MultiPolygon"

_SLACK = 0.35  # of the smallest token's area, by which a part's may be wrong
_DUST = 0.2  # of it: smaller parts are left unfilled
_GRID = 1e-7  # of the root of all tokens' area, to which corners are rounded
_TURN = np.radians(1.0)  # by which a corner may be wrong, and more where its sides are short
_CONVEX = np.radians(179.0)
_GROWN = 1.5  # tolerances that a token may reach out of what is left
_MITRE = 5.0  # of the sharpest corner, 45 degrees: 2.6


class Laid(NamedTuple):
    """A token in its place.

    Attributes:
        shape: number among the different shapes.
        flipped: whether it lies on its other side.
        pose: (3,) x, y and angle.
    """

    shape: int
    flipped: bool
    pose: Floats


@dataclass(frozen=True, eq=False)
class Dissection:
    """K tokens that fill an outline, by poses (K, 3) and sides (K,)."""

    poses: Floats
    flipped: Bools


@dataclass(frozen=True, eq=False)
class _Corner:
    """A corner of a shape on one side, in the frame of the edge that leaves it.

    Attributes:
        shape: number among the different shapes.
        flipped: the side.
        angle: inside of it.
        leaving, coming: lengths of its edges.
        body: (C,) all corners, this one at 0 and the next one on the positive x axis.
        place: this corner in the body frame.
        along: the direction of the edge that leaves it there.
    """

    shape: int
    flipped: bool
    angle: float
    leaving: float
    coming: float
    body: Complex
    place: complex
    along: complex


@dataclass
class Budget:
    """What a search may cost, and what it did.

    Attributes:
        until: when it ends, see `time.perf_counter`.
        nodes: steps that it may take.
        taken: steps that were taken.
    """

    until: float
    nodes: int = 100_000
    taken: int = 0

    def spent(self) -> bool:
        """Whether the search must end."""
        return self.taken >= self.nodes or time.perf_counter() > self.until


class Tokens:
    """A layout's tokens as what fills an outline.

    Attributes:
        own: the tokens of each shape.
        counts: how many they are.
        areas: (S,) of each shape.
        unit: the root of all tokens' area, the side of the full square that tans are cut from.
        corners: the different corners of all shapes, on both sides.
    """

    def __init__(self, layout: Layout) -> None:
        """Find which of them are alike, and their different corners."""
        kinds = kinds_of(layout, 1.0, 1)  # in the units of the layout
        shapes = {kind.shape: kind for kind in kinds}
        self.own = [kind.tokens for kind in shapes.values()]
        self.counts = tuple(map(len, self.own))
        self.areas = np.array([kind.area for kind in shapes.values()])
        self.unit = float(np.sqrt(layout.areas.sum()))
        most = max(len(kind.corners) for kind in kinds)
        # Large ones first: what is left is then hard to fill, and that is soon seen.
        self.corners = [
            corner
            for kind in sorted(kinds, key=lambda kind: -kind.area)
            for corner in _corners(kind, most)
        ]

    @cached_property
    def angles(self) -> Floats:
        """Angles that corners of tokens make together, up to a straight one."""
        single = sorted({round(corner.angle, 9) for corner in self.corners})
        sums, new = set(single), set(single)
        while new:
            new = {a + b for a in new for b in single if a + b < np.pi + 1e-6} - sums
            sums |= new
        return np.array(sorted(sums))

    @cached_property
    def sets(self) -> tuple[Ints, Floats]:
        """All sets of tokens but the empty one: how many of each shape (N, S), and their areas."""
        sets = np.array(list(product(*(range(count + 1) for count in self.counts))))[1:]
        return sets, sets @ self.areas


class Search:
    """Fills one outline with all tokens of a set.

    Attributes:
        budget: what it may cost.
    """

    def __init__(self, tokens: Tokens, tolerance: float, budget: Budget) -> None:
        """Search with a tolerance: how far an outline's sides may be from where they should be."""
        self._tokens, self._tolerance, self.budget = tokens, tolerance, budget
        self._least = float(tokens.areas.min())

    def run(self, outline: Area) -> Iterator[list[Laid]]:
        """Different ways to fill an outline; there are no others where the budget was enough."""
        yield from self._fill(shapely.make_valid(outline), self._tokens.counts, [])

    def _fill(self, rest: Area, left: tuple[int, ...], laid: list[Laid]) -> Iterator[list[Laid]]:
        parts = [part for part in _polygons(rest) if part.area > _DUST * self._least]
        if not parts:
            if not any(left):
                yield laid
            return
        self.budget.taken += 1
        if self.budget.spent() or not self._divides([part.area for part in parts], left):
            return
        for one, polygon in self._fewest(parts, left):
            now = tuple(count - (shape == one.shape) for shape, count in enumerate(left))
            gone = shapely.difference(rest, polygon, grid_size=_GRID * self._tokens.unit)
            yield from self._fill(self._opened(gone), now, [*laid, one])
            if self.budget.spent():
                return

    def _opened(self, rest: Area) -> Area:
        """Without slivers narrower than two tolerances."""
        return grown(grown(rest, -self._tolerance), self._tolerance)

    def _divides(self, areas: Sequence[float], left: tuple[int, ...]) -> bool:
        """Whether tokens that are left have the areas of all parts."""
        sets, sizes = self._tokens.sets
        if not areas:
            return not any(left)
        fits = (np.abs(sizes - areas[0]) < _SLACK * self._least) & (sets <= left).all(axis=1)
        if len(areas) == 1:
            return bool((sets[fits] == left).all(axis=1).any())
        return any(
            self._divides(areas[1:], tuple(count - n for count, n in zip(left, own, strict=True)))
            for own in sets[fits].tolist()
        )

    def _fewest(
        self, parts: Sequence[Polygon], left: tuple[int, ...]
    ) -> list[tuple[Laid, Polygon]]:
        """What may lie at the corner where least may; empty where nothing fits somewhere."""
        best: list[tuple[Laid, Polygon]] | None = None
        for part in parts:
            for options in self._options(part, left):
                if best is None or len(options) < len(best):
                    best = options
                if not best:
                    return []
        return best or []

    def _options(
        self, part: Polygon, left: tuple[int, ...]
    ) -> Iterator[list[tuple[Laid, Polygon]]]:
        """For each convex corner of a part the tokens that may lie there."""
        tried, corners, at = [], [], []
        options: list[list[tuple[Laid, Polygon]]] = []
        for point, along, angle, leaving, coming in self._convex(part):
            slack = _TURN + 3.0 * self._tolerance / min(abs(leaving), abs(coming))
            if np.abs(self._tokens.angles - angle).min() > slack:
                yield []  # no corners of tokens make this one
                return
            options.append([])
            for corner in self._tokens.corners:
                if not left[corner.shape] or corner.angle > angle + slack:
                    continue
                # A negative length is that of a side that may go on straight inside.
                if 0.0 < leaving < corner.leaving - self._tolerance:
                    continue
                if 0.0 < coming < corner.coming - self._tolerance and corner.angle > angle - slack:
                    continue
                tried.append(point + along * corner.body)
                corners.append((corner, point, along))
                at.append(options[-1])
        if tried:
            z = np.array(tried)
            polygons = shapely.polygons(np.stack([z.real, z.imag], axis=-1))
            room = grown(part, _GROWN * self._tolerance)
            shapely.prepare(room)
            for i in np.flatnonzero(shapely.contains(room, polygons)).tolist():
                at[i].append((_laid(*corners[i]), polygons[i]))
        yield from options

    def _convex(self, part: Polygon) -> Iterator[tuple[complex, complex, float, float, float]]:
        """Each convex corner: its place, the direction of the side that leaves it, and its angle.

        Then the lengths of the sides that leave it and come to it, negative where they end at a
        corner that is not convex.
        """
        for ring, outer in ((part.exterior, True), *((hole, False) for hole in part.interiors)):
            z: Complex = np.asarray(ring.coords)[:-1] @ np.array([1.0, 1.0j])
            if ring.is_ccw != outer:
                z = z[::-1]
            z = straightened(z, self._tolerance)
            if len(z) < 3:
                continue
            ahead, behind = np.roll(z, -1) - z, np.roll(z, 1) - z
            inside = np.angle(behind / ahead) % (2.0 * np.pi)
            convex = inside < _CONVEX
            signs = np.where(convex, 1.0, -1.0)
            leaving, coming = np.abs(ahead) * np.roll(signs, -1), np.abs(behind) * np.roll(signs, 1)
            for i in np.flatnonzero(convex).tolist():
                along = complex(ahead[i] / abs(ahead[i]))
                lengths = float(leaving[i]), float(coming[i])
                yield complex(z[i]), along, float(inside[i]), *lengths


def dissection(tokens: Tokens, laid: Sequence[Laid]) -> Dissection:
    """What was found, token by token of the layout."""
    count = sum(tokens.counts)
    poses, flipped = np.zeros((count, 3)), np.zeros(count, np.bool_)
    left = [list(own) for own in tokens.own]
    for one in laid:
        token = left[one.shape].pop(0)
        poses[token], flipped[token] = one.pose, one.flipped
    return Dissection(poses, flipped)


@np.errstate(invalid="ignore", divide="ignore")  # of corners all but within a straight side
def grown(area: Area, distance: float) -> Area:
    """An area with all sides so far further out, or in where the distance is negative."""
    return shapely.buffer(area, distance, join_style="mitre", mitre_limit=_MITRE)


def straightened(z: Complex, tolerance: float) -> Complex:
    """Corners (n,) of a ring without those that lie within a straight side, or on another."""
    z = z[np.abs(z - np.roll(z, 1)) > 0.5 * tolerance]
    while len(z) > 3:
        before = np.roll(z, 1)
        side = np.roll(z, -1) - before
        off = np.abs(((z - before) * side.conj()).imag) / np.maximum(np.abs(side), 1e-12)
        least = int(off.argmin())
        if off[least] > 0.7 * tolerance:
            break
        z = np.delete(z, least)
    return z


def _polygons(area: Area) -> list[Polygon]:
    return [one for one in shapely.get_parts(area).tolist() if one.geom_type == "Polygon"]


def _corners(kind: Kind, most: int) -> Iterator[_Corner]:
    """The corners of a shape on one side of which no turn makes another."""
    body: Complex = kind.corners @ np.array([1.0, 1j])
    for i in range(kind.different):
        leaving, coming = body[(i + 1) % len(body)] - body[i], body[i - 1] - body[i]
        along = leaving / abs(leaving)
        own = np.roll((body - body[i]) / along, -i)
        yield _Corner(
            kind.shape,
            kind.flipped,
            float(np.angle(coming / leaving)),
            float(abs(leaving)),
            float(abs(coming)),
            np.concatenate([own, np.repeat(own[-1:], most - len(own))]),
            complex(body[i]),
            complex(along),
        )


def _laid(corner: _Corner, point: complex, along: complex) -> Laid:
    turn = along / corner.along
    place = point - corner.place * turn
    return Laid(corner.shape, corner.flipped, np.array([place.real, place.imag, np.angle(turn)]))
