"""A silhouette -> where a layout's tokens lie that fill it.

An outline is searched as it is, with rising tolerance. A picture is outlined in several ways; each
dissection that the search finds is fitted to all pixels, and what then differs judges. Where
nothing fills it, the tokens that could be laid are looked for in the time that is left.

Legend: K tokens, P pixels along a side of a picture.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import shapely
from shapely import Polygon

from tangram_sim.arrays import Complex, Floats, Singles
from tangram_sim.dissections import (
    Area,
    Budget,
    Dissection,
    Laid,
    Search,
    Tokens,
    dissection,
    grown,
    straightened,
)
from tangram_sim.geometry import outlines
from tangram_sim.layout import Layout
from tangram_vision.kinds import Kind, kinds_of
from tangram_vision.outlines import BINARY_WAYS, GREY_WAYS, Way, outline
from tangram_vision.ramps import fitted, ramps
from tangram_vision.samples import binary

# Of the root of all tokens' area, the full square's side where they are the tans.
TOLERANCES = (0.004, 0.008, 0.014, 0.022, 0.035, 0.05, 0.07, 0.09)
SOLVED = 0.95  # IoU from which a silhouette counts as filled
_EACH_S = 0.5  # that one outline of a picture is searched
_EACH = 2  # dissections of an outline that are compared
_ALIKE = 0.02  # of a picture that may differ where the search ends
_MARGIN = 3  # pixels around a silhouette
_ROUND = 1e-9
# Of the root of all tokens' area: gaps between pieces that are closed, and what a side of an
# outline may be off so that no corner of a piece within it is left.
_SEAM, _STRAIGHT, _GRID = 0.004, 1e-4, 1e-6
_SHARE = 0.9  # of the time, for the search; the rest is for the best attempt
_LOOSE = (0.008, 0.022, 0.05)  # tolerances of attempts
_LOOSE_STEPS = 100
_SAME = 0.9  # of a token's area, from which two lie at one place


@dataclass(frozen=True, eq=False)
class Filled:
    """How a silhouette was filled.

    Attributes:
        found: the dissection that fits best; None if none was found.
        iou: intersection over union of its tokens and the outline, or the picture's pixels; of the
            attempt where nothing was found.
        seconds: that it took.
        nodes: steps of the search.
        complete: whether all of an outline was searched: no other dissection fills it.
        attempt: where nothing was found, the tokens that could be laid; None if none could.
    """

    found: Dissection | None
    iou: float
    seconds: float
    nodes: int
    complete: bool
    attempt: Dissection | None = None

    @property
    def solved(self) -> bool:
        """Whether the silhouette counts as filled."""
        return self.found is not None and self.iou >= SOLVED


def pieces(layout: Layout, found: Dissection) -> list[Polygon]:
    """The tokens of a dissection that were laid."""
    corners = layout.corners(found.poses, found.flipped)
    every = outlines(corners[None], layout)[0]
    return [Polygon(every[token]) for token in found.laid.tolist()]


def covered(layout: Layout, found: Dissection) -> Area:
    """What the tokens of a dissection cover."""
    size = _ROUND * float(np.sqrt(layout.areas.sum()))
    return shapely.union_all(pieces(layout, found), grid_size=size)


def silhouette(layout: Layout, laid: Dissection) -> Area:
    """What tokens cover, by its outline alone: the same whatever pieces it is made of.

    No seam is left and no corner of a piece within a straight side, and where a ring begins does
    not depend on the pieces.
    """
    unit = float(np.sqrt(layout.areas.sum()))
    closed = grown(grown(covered(layout, laid), _SEAM * unit), -_SEAM * unit)

    def ring(points: Floats) -> Floats:
        z: Complex = points[:-1] @ np.array([1.0, 1.0j])
        z = straightened(z, _STRAIGHT * unit)
        rounded: Floats = np.round(np.stack([z.real, z.imag], axis=-1) / (_GRID * unit))
        return rounded * (_GRID * unit)

    parts = []
    for part in shapely.get_parts(closed).tolist():
        outer, *holes = (ring(np.asarray(one.coords)) for one in (part.exterior, *part.interiors))
        parts.append(Polygon(outer, holes))
    return shapely.normalize(shapely.union_all(parts))


def overlap(one: Area, other: Area) -> float:
    """Intersection over union of two areas."""
    size = _ROUND * float(np.sqrt(one.area + other.area))
    common = shapely.intersection(one, other, grid_size=size).area
    return float(common / max(one.area + other.area - common, 1e-300))


def fill_outline(area: Area, layout: Layout, seconds: float, count: int = 1) -> list[Filled]:
    """Up to `count` different dissections of an outline of the tokens' area, or one that failed.

    Args:
        area: in the units of the layout.
        layout: its tokens.
        seconds: for all of it.
        count: at most so many.
    """
    tokens, begin = Tokens(layout), time.perf_counter()
    budget, tried = Budget(begin + _SHARE * seconds), list[list[Laid]]()
    for tolerance in TOLERANCES:
        search = Search(tokens, tolerance * tokens.unit, budget)
        every: list[Filled] = []
        for laid in search.run(area):
            found = dissection(tokens, laid)
            iou = overlap(covered(layout, found), area)
            if iou >= SOLVED and not any(_alike(tokens, layout, found, one.found) for one in every):
                passed = time.perf_counter() - begin
                every.append(Filled(found, iou, passed, budget.taken, False))
            if len(every) == count:
                return every
        tried.append(search.best)
        if every or budget.spent():
            break
    complete = not budget.spent()
    if every:
        return [replace(one, complete=complete) for one in every]
    nearest, iou = _attempted(area, layout, tokens, begin + seconds, tried)
    return [Filled(None, iou, time.perf_counter() - begin, budget.taken, complete, nearest)]


def attempt_outline(area: Area, layout: Layout, seconds: float) -> Filled:
    """The tokens that could be laid in an outline whose area is not theirs."""
    tokens, begin = Tokens(layout), time.perf_counter()
    nearest, iou = _attempted(area, layout, tokens, begin + seconds, ())
    return Filled(None, iou, time.perf_counter() - begin, 0, False, nearest)


def _attempted(
    area: Area, layout: Layout, tokens: Tokens, until: float, tried: Sequence[list[Laid]]
) -> tuple[Dissection | None, float]:
    """What comes nearest to an outline, of what was tried and of loose searches; and its IoU."""
    every = [*tried]
    for tolerance in _LOOSE:
        search = Search(tokens, tolerance * tokens.unit, Budget(until, _LOOSE_STEPS), loose=True)
        next(search.run(area), None)
        every.append(search.best)
    found = [dissection(tokens, laid) for laid in every if laid]
    if not found:
        return None, 0.0
    shares = [overlap(covered(layout, one), area) for one in found]
    # Tokens that lie on others cover nothing of their own.
    twice = [
        sum(piece.area for piece in pieces(layout, one)) - covered(layout, one).area
        for one in found
    ]
    best = int(np.argmax(np.array(shares) - np.array(twice) / area.area))
    return found[best], shares[best]


def _alike(tokens: Tokens, layout: Layout, one: Dissection, other: Dissection | None) -> bool:
    """Whether two dissections differ by nothing but which of equal tokens lies where."""
    if other is None:
        return False
    mine, theirs = np.array(pieces(layout, one)), np.array(pieces(layout, other))
    for own in map(list, tokens.own):
        common = shapely.area(shapely.intersection(mine[own][:, None], theirs[own]))
        if (common.max(axis=1) < _SAME * shapely.area(mine[own])).any():
            return False
    return True


def fill_picture(cover: Singles, layout: Layout, view: float, seconds: float) -> Filled:
    """The dissection that explains a picture's coverage (P, P) best.

    Args:
        cover: about 0 on the ground and 1 in the silhouette.
        layout: the tokens.
        view: width of the picture, in the units of the layout.
        seconds: for all of it.
    """
    tokens, begin = Tokens(layout), time.perf_counter()
    kinds, unit = kinds_of(layout, view, len(cover)), view / len(cover)
    crop, corner = _cropped(cover)
    sharp = binary(cover)
    ways = BINARY_WAYS if sharp else GREY_WAYS
    budget, tried = Budget(begin + _SHARE * seconds), list[list[Laid]]()
    best, iou, least = None, 0.0, np.inf
    for found in _tried(crop, ways, tokens, unit, budget, tried):
        own, rough = _in_pixels(found, kinds, unit)
        poses, differs = fitted(own, rough, crop)
        if differs < least:
            least, iou = differs, _pixel_overlap(own, poses, crop, sharp)
            best = moved(Dissection(poses * (unit, unit, 1.0), found.flipped), corner * unit)
        if least < _ALIKE:
            break
    nearest = None
    if best is None:
        area = shapely.transform(outline(crop, ways[0]), lambda points: points * unit)
        laid, iou = _attempted(area, layout, tokens, begin + seconds, tried)
        nearest = None if laid is None else moved(laid, corner * unit)
    return Filled(best, iou, time.perf_counter() - begin, budget.taken, False, nearest)


def _tried(
    crop: Singles,
    ways: Sequence[Way],
    tokens: Tokens,
    unit: float,
    budget: Budget,
    tried: list[list[Laid]],
) -> Iterator[Dissection]:
    """Dissections of the outlines that a picture may have, in the units of the layout.

    What each search laid at most goes into `tried`.
    """
    end = budget.until
    for way in ways:
        area = shapely.transform(outline(crop, way), lambda points: points * unit)
        for tolerance in TOLERANCES[1:]:
            budget.until = min(time.perf_counter() + _EACH_S, end)
            search = Search(tokens, tolerance * tokens.unit, budget)
            yield from (dissection(tokens, laid) for laid in islice(search.run(area), _EACH))
            tried.append(search.best)
            if time.perf_counter() > end:
                return


def _pixel_overlap(kinds: Sequence[Kind], poses: Floats, cover: Singles, sharp: bool) -> float:
    """Intersection over union of tokens and coverage (P, P), which is sharp or grey at edges."""
    drawn = np.minimum(ramps(kinds, poses, len(cover)).sum(axis=0), 1.0)
    seen = np.clip(cover, 0.0, 1.0)
    if sharp:
        drawn = np.round(drawn)
    return float(np.minimum(drawn, seen).sum() / np.maximum(drawn, seen).sum())


def _cropped(cover: Singles) -> tuple[Singles, Floats]:
    """The square around what is covered, and its upper left corner, x and y, in pixels."""
    rows, columns = (np.flatnonzero((cover > 0.3).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return cover, np.zeros(2)
    top, left = max(0, int(rows[0]) - _MARGIN), max(0, int(columns[0]) - _MARGIN)
    part = cover[top : int(rows[-1]) + _MARGIN + 1, left : int(columns[-1]) + _MARGIN + 1]
    side = max(part.shape)
    room = ((0, side - part.shape[0]), (0, side - part.shape[1]))
    return np.pad(part, room), np.array([left, -top], np.float64)


def moved(found: Dissection, way: Floats) -> Dissection:
    """The same dissection so far (2,) away."""
    return replace(found, poses=found.poses + (*way, 0.0))


def _in_pixels(found: Dissection, kinds: Sequence[Kind], unit: float) -> tuple[list[Kind], Floats]:
    """Kinds and poses (K, 3) of a dissection's tokens, as pictures have them."""
    own = [
        next(kind for kind in kinds if token in kind.tokens and kind.flipped == flipped)
        for token, flipped in enumerate(found.flipped.tolist())
    ]
    return own, found.poses / (unit, unit, 1.0)
