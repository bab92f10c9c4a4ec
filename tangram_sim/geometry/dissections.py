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
from typing import NamedTuple

import numpy as np
import shapely
from shapely import Polygon

from tangram_core.arrays import Bools, Complex, Floats, Ints
from tangram_sim.geometry.areas import Area, grown, opened, polygons, rings, valid
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.sides import Side, sides_of

_SLACK = 0.35  # of the smallest token's area, by which a part's may be wrong
_DUST = 0.2  # of it: smaller parts are left unfilled
_GRID = 1e-7  # of the root of all tokens' area, to which corners are rounded
_TURN = np.radians(1.0)  # by which a corner may be wrong, and more where its sides are short
_CONVEX = np.radians(179.0)
_GROWN = 1.5  # tolerances that a token may reach out of what is left


class Laid(NamedTuple):
    """A token of a shape, by its number, on one side, in its place: pose (3,) is x, y and angle."""

    shape: int
    flipped: bool
    pose: Floats


class Place(NamedTuple):
    """A token in its place, and what comes of it.

    Attributes:
        laid: the token.
        rest: what is left to fill.
        left: how many tokens are left of each shape.
        filled: whether all is filled, and no token left.
        dead: whether what is left has parts of which no tokens have the areas.
    """

    laid: Laid
    rest: Area
    left: tuple[int, ...]
    filled: bool
    dead: bool


@dataclass(frozen=True, eq=False)
class Dissection:
    """K tokens that fill an outline, or some of them that could be laid.

    Attributes:
        poses: (K, 3) x, y and angle.
        flipped: (K,) which lie on their other side.
        lies: (K,) which were laid; None is all.
    """

    poses: Floats
    flipped: Bools
    lies: Bools | None = None

    @property
    def laid(self) -> Ints:
        """Numbers of the tokens that were laid."""
        every = np.arange(len(self.poses))
        return every if self.lies is None else every[self.lies]


@dataclass(frozen=True, eq=False)
class Corner:
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
    """What a search may cost, and what it did, in steps.

    Attributes:
        until: when it ends, see `time.thread_time`.
    """

    until: float
    nodes: int = 100_000
    taken: int = 0

    def spent(self) -> bool:
        """Whether the search must end."""
        return self.taken >= self.nodes or time.thread_time() > self.until


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
        sides = sides_of(layout)
        shapes = {side.shape: side for side in sides}
        self.own = [side.tokens for side in shapes.values()]
        self.counts = tuple(map(len, self.own))
        self.areas = np.array([side.area for side in shapes.values()])
        self.unit = float(np.sqrt(layout.areas.sum()))
        most = max(len(side.corners) for side in sides)
        # Large ones first: what is left is then hard to fill, and that is soon seen.
        self.corners = [
            corner
            for side in sorted(sides, key=lambda side: -side.area)
            for corner in _corners(side, most)
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
        best: the tokens of greatest area that were laid at a time.
    """

    def __init__(self, tokens: Tokens, tolerance: float, budget: Budget) -> None:
        """Allow an outline's sides to be off by a tolerance, in the units of the outline."""
        self._tokens, self._tolerance, self.budget = tokens, tolerance, budget
        self._least = float(tokens.areas.min())
        self.best: list[Laid] = []
        self._most = 0.0

    def run(self, outline: Area) -> Iterator[list[Laid]]:
        """Different ways to fill an outline; there are no others where the budget was enough."""
        yield from self._fill(valid(outline), self._tokens.counts, [])

    def _fill(self, rest: Area, left: tuple[int, ...], laid: list[Laid]) -> Iterator[list[Laid]]:
        area = float(sum(self._tokens.areas[one.shape] for one in laid))
        if area > self._most:
            self.best, self._most = laid, area
        parts = parts_of(rest, self._least)
        if not parts:
            if not any(left):
                yield laid
            return
        self.budget.taken += 1
        if self.budget.spent():
            return
        if not self._divides([part.area for part in parts], left):
            return
        for one, polygon in self._fewest(parts, left):
            yield from self._fill(self._without(rest, polygon), less(left, one), [*laid, one])
            if self.budget.spent():
                return

    def places(self, rest: Area, left: tuple[int, ...]) -> list[Place]:
        """All that may lie at the corner where least may, and what then is left to fill."""
        parts = parts_of(rest, self._least)
        if not parts or not self.fits(rest, left):
            return []
        places = []
        for one, polygon in self._fewest(parts, left):
            gone, now = self._without(rest, polygon), less(left, one)
            open_to = self.fits(gone, now)
            places.append(Place(one, gone, now, filled=open_to and not any(now), dead=not open_to))
        return places

    def fits(self, rest: Area, left: tuple[int, ...]) -> bool:
        """Whether all tokens that are left have the areas of all parts of what is left to fill.

        Without a token left: whether nothing is left to fill.
        """
        return self._divides([part.area for part in parts_of(rest, self._least)], left)

    def _without(self, rest: Area, polygon: Polygon) -> Area:
        return without(rest, polygon, self._tolerance, self._tokens.unit)

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
        for point, along, angle, leaving, coming in convex_corners(part, self._tolerance):
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
                at[i].append((laid_at(*corners[i]), polygons[i]))
        yield from options


def parts_of(rest: Area, least: float) -> list[Polygon]:
    """The parts of what is left to fill, without dust; the smallest token has the area `least`."""
    return [part for part in polygons(rest) if part.area > _DUST * least]


def without(rest: Area, laid: Area, tolerance: float, unit: float) -> Area:
    """What tokens leave of what was left, without slivers narrower than two tolerances.

    The unit is the root of all tokens' area.
    """
    return opened(shapely.difference(rest, laid, grid_size=_GRID * unit), tolerance)


def convex_corners(
    part: Polygon, tolerance: float
) -> Iterator[tuple[complex, complex, float, float, float]]:
    """Each convex corner: its place, the direction of the side that leaves it, and its angle.

    Then the lengths of the sides that leave it and come to it, negative where they end at a
    corner that is not convex.
    """
    for z, _, _ in rings(part, tolerance):
        ahead, behind = np.roll(z, -1) - z, np.roll(z, 1) - z
        inside = np.angle(behind / ahead) % (2.0 * np.pi)
        convex = inside < _CONVEX
        signs = np.where(convex, 1.0, -1.0)
        leaving, coming = np.abs(ahead) * np.roll(signs, -1), np.abs(behind) * np.roll(signs, 1)
        for i in np.flatnonzero(convex).tolist():
            along = complex(ahead[i] / abs(ahead[i]))
            lengths = float(leaving[i]), float(coming[i])
            yield complex(z[i]), along, float(inside[i]), *lengths


def less(left: tuple[int, ...], one: Laid) -> tuple[int, ...]:
    """How many tokens are left of each shape without one."""
    return tuple(count - (shape == one.shape) for shape, count in enumerate(left))


def dissection(tokens: Tokens, laid: Sequence[Laid]) -> Dissection:
    """What was found, token by token of the layout; some may not have been laid."""
    count = sum(tokens.counts)
    poses, flipped = np.zeros((count, 3)), np.zeros(count, np.bool_)
    lies = np.zeros(count, np.bool_)
    left = [list(own) for own in tokens.own]
    for one in laid:
        token = left[one.shape].pop(0)
        poses[token], flipped[token], lies[token] = one.pose, one.flipped, True
    return Dissection(poses, flipped, None if lies.all() else lies)


def _corners(side: Side, most: int) -> Iterator[Corner]:
    """The corners of a shape on one side of which no turn makes another."""
    body: Complex = side.corners @ np.array([1.0, 1j])
    for i in range(side.different):
        leaving, coming = body[(i + 1) % len(body)] - body[i], body[i - 1] - body[i]
        along = leaving / abs(leaving)
        own = np.roll((body - body[i]) / along, -i)
        yield Corner(
            side.shape,
            side.flipped,
            float(np.angle(coming / leaving)),
            float(abs(leaving)),
            float(abs(coming)),
            np.concatenate([own, np.repeat(own[-1:], most - len(own))]),
            complex(body[i]),
            complex(along),
        )


def laid_at(corner: Corner, point: complex, along: complex) -> Laid:
    """A token with a corner at a point, and the edge that leaves it along a direction."""
    turn = along / corner.along
    place = point - corner.place * turn
    return Laid(corner.shape, corner.flipped, np.array([place.real, place.imag, np.angle(turn)]))
