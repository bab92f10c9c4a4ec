"""A silhouette -> where a layout's tokens lie that fill it.

An outline is searched as it is, with rising tolerance. A picture is outlined in several ways; each
dissection that the search finds is fitted to all pixels, and what then differs judges.

Legend: K tokens, P pixels along a side of a picture.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
import shapely
from shapely import Polygon

from tangram_sim.arrays import Floats, Singles
from tangram_sim.geometry import outlines
from tangram_sim.layout import Layout
from tangram_vision.dissections import Area, Budget, Dissection, Search, Tokens, dissection
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


@dataclass(frozen=True, eq=False)
class Filled:
    """How a silhouette was filled.

    Attributes:
        found: the dissection that fits best; None if none was found.
        iou: intersection over union of its tokens and the outline, or the picture's pixels.
        seconds: that it took.
        nodes: steps of the search.
        complete: whether all of an outline was searched: where nothing was found, nothing fills it.
    """

    found: Dissection | None
    iou: float
    seconds: float
    nodes: int
    complete: bool


def covered(layout: Layout, found: Dissection) -> Area:
    """What the tokens of a dissection cover."""
    corners = layout.corners(found.poses, found.flipped)
    pieces = [Polygon(one) for one in outlines(corners[None], layout)[0]]
    return shapely.union_all(pieces, grid_size=_ROUND * float(np.sqrt(layout.areas.sum())))


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
    budget = Budget(begin + seconds)
    for tolerance in TOLERANCES:
        every: list[Filled] = []
        for laid in Search(tokens, tolerance * tokens.unit, budget).run(area):
            found = dissection(tokens, laid)
            iou = overlap(covered(layout, found), area)
            if iou >= SOLVED:
                passed = time.perf_counter() - begin
                every.append(Filled(found, iou, passed, budget.taken, False))
            if len(every) == count:
                break
        if every or budget.spent():
            break
    failed = Filled(None, 0.0, time.perf_counter() - begin, budget.taken, not budget.spent())
    return every or [failed]


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
    budget = Budget(begin + seconds)
    best, iou, least = None, 0.0, np.inf
    for found in _tried(crop, ways, tokens, unit, budget):
        own, rough = _in_pixels(found, kinds, unit)
        poses, differs = fitted(own, rough, crop)
        if differs < least:
            least, iou = differs, _pixel_overlap(own, poses, crop, sharp)
            places = (poses[:, :2] + corner) * unit
            best = Dissection(np.column_stack([places, poses[:, 2]]), found.flipped)
        if least < _ALIKE:
            break
    return Filled(best, iou, time.perf_counter() - begin, budget.taken, False)


def _tried(
    crop: Singles, ways: Sequence[Way], tokens: Tokens, unit: float, budget: Budget
) -> Iterator[Dissection]:
    """Dissections of the outlines that a picture may have, in the units of the layout."""
    end = budget.until
    for way in ways:
        area = shapely.transform(outline(crop, way), lambda points: points * unit)
        for tolerance in TOLERANCES[1:]:
            budget.until = min(time.perf_counter() + _EACH_S, end)
            search = Search(tokens, tolerance * tokens.unit, budget).run(area)
            yield from (dissection(tokens, laid) for laid in islice(search, _EACH))
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


def _in_pixels(found: Dissection, kinds: Sequence[Kind], unit: float) -> tuple[list[Kind], Floats]:
    """Kinds and poses (K, 3) of a dissection's tokens, as pictures have them."""
    own = [
        next(kind for kind in kinds if token in kind.tokens and kind.flipped == flipped)
        for token, flipped in enumerate(found.flipped.tolist())
    ]
    return own, found.poses / (unit, unit, 1.0)
