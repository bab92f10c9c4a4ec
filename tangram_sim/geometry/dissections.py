"""A complete search for poses of tokens that fill an outline, corner by corner.

The rest is the area that is still to fill. At each of its convex corners some token must have a
corner too, with an edge along a side of the rest. So only few places are possible. The search goes
on at the corner with the fewest places. Each part of the rest must have the area of some tokens.

Points and directions are complex numbers here. Legend: S different shapes, n candidates, C corners
of a token, padded to those of the largest by repeating the last one.
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

_SLACK = 0.35  # error allowed in a part's area, as a share of the smallest token's area
_DUST = 0.2  # parts below this share of the smallest token's area are left unfilled
_GRID = 1e-7  # grid for corners, as a share of the square root of the tokens' total area
_TURN = np.radians(1.0)  # error allowed in a corner's angle; more where its sides are short
_CONVEX = np.radians(179.0)
_GROWN = 1.5  # tolerances by which a token may reach out of the rest


class Laid(NamedTuple):
    """A laid token: number of its shape, whether turned over, and pose (3,): x, y and angle."""

    shape: int
    flipped: bool
    pose: Floats


class Place(NamedTuple):
    """A possible place of a token, and the state of the search after it is laid there.

    Attributes:
        laid: the token.
        rest: the area that is left to fill.
        left: number of tokens left of each shape.
        filled: whether all is filled and no token is left.
        dead: whether the tokens left cannot match the areas of the parts of the rest.
    """

    laid: Laid
    rest: Area
    left: tuple[int, ...]
    filled: bool
    dead: bool


@dataclass(frozen=True, eq=False)
class Dissection:
    """Poses of K tokens that fill an outline, or of those that could be laid.

    Attributes:
        poses: (K, 3) x, y and angle.
        flipped: (K,) which tokens are turned over.
        lies: (K,) which tokens were laid; None: all.
    """

    poses: Floats
    flipped: Bools
    lies: Bools | None = None

    @property
    def laid(self) -> Ints:
        """Indices of the tokens that were laid."""
        every = np.arange(len(self.poses))
        return every if self.lies is None else every[self.lies]


@dataclass(frozen=True, eq=False)
class Corner:
    """A corner of a shape on one side, in the frame of the edge that leaves it.

    Attributes:
        shape: number among the different shapes.
        flipped: whether the shape is turned over.
        angle: interior angle, radians.
        leaving, coming: lengths of the edges after and before the corner.
        body: (C,) all corners, this one at 0 and the next one on the positive x axis.
        place: this corner in the body frame.
        along: direction of the edge after the corner, in the body frame.
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
    """Limits of a search, and its steps so far.

    Attributes:
        until: end time, as `time.thread_time` tells it.
        nodes: largest number of steps.
        taken: steps so far.
    """

    until: float
    nodes: int = 100_000
    taken: int = 0

    def spent(self) -> bool:
        """Whether the search has reached a limit."""
        return self.taken >= self.nodes or time.thread_time() > self.until


class Tokens:
    """A layout's tokens, prepared for the search.

    Attributes:
        own: indices of the tokens of each shape.
        counts: number of tokens of each shape.
        areas: (S,) of each shape.
        unit: square root of the tokens' total area, the side of the full square of the tans.
        corners: the different corners of all shapes, on both sides.
    """

    def __init__(self, layout: Layout) -> None:
        """Group equal tokens, and find the different corners."""
        sides = sides_of(layout)
        shapes = {side.shape: side for side in sides}
        self.own = [side.tokens for side in shapes.values()]
        self.counts = tuple(map(len, self.own))
        self.areas = np.array([side.area for side in shapes.values()])
        self.unit = float(np.sqrt(layout.areas.sum()))
        most = max(len(side.corners) for side in sides)
        # Large shapes first: a wrong choice then fails sooner.
        self.corners = [
            corner
            for side in sorted(sides, key=lambda side: -side.area)
            for corner in _corners(side, most)
        ]

    @cached_property
    def angles(self) -> Floats:
        """All sums of the tokens' corner angles up to pi, sorted."""
        single = sorted({round(corner.angle, 9) for corner in self.corners})
        sums, new = set(single), set(single)
        while new:
            new = {a + b for a in new for b in single if a + b < np.pi + 1e-6} - sums
            sums |= new
        return np.array(sorted(sums))

    @cached_property
    def sets(self) -> tuple[Ints, Floats]:
        """All non-empty sets of tokens: counts by shape (N, S), and summed areas (N,)."""
        sets = np.array(list(product(*(range(count + 1) for count in self.counts))))[1:]
        return sets, sets @ self.areas


class Search:
    """Search for ways to fill one outline with all tokens of a set.

    Attributes:
        budget: limits of the search.
        best: of all partial fillings so far, the one with the largest area.
    """

    def __init__(self, tokens: Tokens, tolerance: float, budget: Budget) -> None:
        """Set up a search; sides may be off by `tolerance`, in the unit of the outline."""
        self._tokens, self._tolerance, self.budget = tokens, tolerance, budget
        self._least = float(tokens.areas.min())
        self.best: list[Laid] = []
        self._most = 0.0

    def run(self, outline: Area) -> Iterator[list[Laid]]:
        """Yield the different ways to fill an outline: all of them, if the budget is enough."""
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
            yield from self._fill(self._without(rest, polygon), less(left, one.shape), [*laid, one])
            if self.budget.spent():
                return

    def places(self, rest: Area, left: tuple[int, ...]) -> list[Place]:
        """The possible places at the corner with the fewest; empty if nothing can be laid."""
        parts = parts_of(rest, self._least)
        if not parts or not self.fits(rest, left):
            return []
        places = []
        for one, polygon in self._fewest(parts, left):
            gone, now = self._without(rest, polygon), less(left, one.shape)
            open_to = self.fits(gone, now)
            places.append(Place(one, gone, now, filled=open_to and not any(now), dead=not open_to))
        return places

    def fits(self, rest: Area, left: tuple[int, ...]) -> bool:
        """Whether the tokens left can be divided among the parts of the rest by their areas.

        If no token is left: whether the rest is empty.
        """
        return self._divides([part.area for part in parts_of(rest, self._least)], left)

    def _without(self, rest: Area, polygon: Polygon) -> Area:
        return without(rest, polygon, self._tolerance, self._tokens.unit)

    def _divides(self, areas: Sequence[float], left: tuple[int, ...]) -> bool:
        """Whether the tokens left can be divided among parts of these areas."""
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
        """The options at the corner with the fewest; empty if some corner has none."""
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
        """For each convex corner of a part, the tokens that may lie there."""
        tried, corners, at = [], [], []
        options: list[list[tuple[Laid, Polygon]]] = []
        for point, along, angle, leaving, coming in convex_corners(part, self._tolerance):
            slack = _TURN + 3.0 * self._tolerance / min(abs(leaving), abs(coming))
            if np.abs(self._tokens.angles - angle).min() > slack:
                yield []  # no sum of tokens' corners has this angle
                return
            options.append([])
            for corner in self._tokens.corners:
                if not left[corner.shape] or corner.angle > angle + slack:
                    continue
                # Negative: the side ends at a reflex corner, so a longer edge may pass it.
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
    """The parts of the rest, without dust; `least` is the area of the smallest token."""
    return [part for part in polygons(rest) if part.area > _DUST * least]


def without(rest: Area, laid: Area, tolerance: float, unit: float) -> Area:
    """The rest without the area of laid tokens, and without slivers narrower than two tolerances.

    `unit` is the square root of the tokens' total area.
    """
    return opened(shapely.difference(rest, laid, grid_size=_GRID * unit), tolerance)


def convex_corners(
    part: Polygon, tolerance: float
) -> Iterator[tuple[complex, complex, float, float, float]]:
    """Yield each convex corner: point, direction of the side after it, angle, and two lengths.

    The lengths are those of the sides after and before the corner, negative for a side whose other
    end is not convex.
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


def less(left: tuple[int, ...], laid: int) -> tuple[int, ...]:
    """The number of tokens left of each shape after one more of the shape `laid` is laid."""
    return tuple(count - (shape == laid) for shape, count in enumerate(left))


def dissection(tokens: Tokens, laid: Sequence[Laid]) -> Dissection:
    """The laid tokens in the order of the layout; some tokens may be missing."""
    count = sum(tokens.counts)
    poses, flipped = np.zeros((count, 3)), np.zeros(count, np.bool_)
    lies = np.zeros(count, np.bool_)
    left = [list(own) for own in tokens.own]
    for one in laid:
        token = left[one.shape].pop(0)
        poses[token], flipped[token], lies[token] = one.pose, one.flipped, True
    return Dissection(poses, flipped, None if lies.all() else lies)


def _corners(side: Side, most: int) -> Iterator[Corner]:
    """The corners of a side of a shape that no rotation maps onto each other."""
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
    """A token with its corner at a point, and the edge after this corner along a direction."""
    turn = along / corner.along
    place = point - corner.place * turn
    return Laid(corner.shape, corner.flipped, np.array([place.real, place.imag, np.angle(turn)]))
