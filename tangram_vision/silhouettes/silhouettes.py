"""Fill the outline of a silhouette with a layout's tokens.

An exact search runs with rising tolerance. If nothing fills the outline, a beam search lays what
tokens it can. Legend: K tokens.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely import Polygon

from tangram_core.arrays import Complex, Floats
from tangram_sim.geometry.areas import Area, overlap, straightened
from tangram_sim.geometry.dissections import Budget, Dissection, Laid, Search, Tokens, dissection
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines
from tangram_sim.geometry.rings import covered_area, unit_of
from tangram_vision.silhouettes.beams import Beam

# Of the root of all tokens' area; for the tans that root is the full square's side.
TOLERANCES = (0.004, 0.008, 0.014, 0.022, 0.035, 0.05, 0.07, 0.09)
SOLVED = 0.95  # IoU from which a silhouette counts as filled
_ROUND = 1e-9  # of the tokens' size: grid to which corners are rounded
# Of the root of all tokens' area: a side may bend by so much and still count as straight, so that
# corners of pieces within it are removed.
_STRAIGHT, _GRID = 1e-4, 1e-6
_SHARE = 0.9  # of the time, for the search; the rest is for the best attempt
_LOOSE = (0.004, 0.022, 0.05)  # tolerances of a beam search, for outlines


@dataclass(frozen=True, eq=False)
class Filled:
    """The result of filling a silhouette.

    Attributes:
        found: the dissection that fits best; None if none was found.
        iou: intersection over union of the tokens and the outline, or the picture's pixels; of the
            attempt, if nothing was found.
        seconds: processor time that was used.
        nodes: steps of the search.
        complete: whether everything was tried, so that no other dissection fills the outline.
        attempt: if nothing was found, the tokens that could be laid; None if none could.
        by: method that found the dissection, search or beam.
    """

    found: Dissection | None
    iou: float
    seconds: float
    nodes: int
    complete: bool
    attempt: Dissection | None = None
    by: str = "search"

    @property
    def solved(self) -> bool:
        """Whether the silhouette counts as filled."""
        return self.found is not None and self.iou >= SOLVED


def pieces(layout: Layout, found: Dissection) -> list[Polygon]:
    """The polygons of the tokens that a dissection lays."""
    corners = layout.corners(found.poses, found.flipped)
    every = outlines(corners[None], layout)[0]
    return [Polygon(every[token]) for token in found.laid.tolist()]


def covered(layout: Layout, found: Dissection) -> Area:
    """The area that the tokens of a dissection cover."""
    size = _ROUND * unit_of(layout)
    return shapely.union_all(pieces(layout, found), grid_size=size)


def silhouette(layout: Layout, laid: Dissection) -> Area:
    """The area that tokens cover; it is the same for every dissection of that area.

    Seams are closed, and corners of pieces within a straight side are removed. The first point of
    a ring does not depend on the pieces.
    """
    unit = unit_of(layout)
    closed = covered_area(layout.corners(laid.poses, laid.flipped), layout)

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


def fill_outline(area: Area, layout: Layout, seconds: float) -> Filled:
    """Find a dissection of an outline of the tokens' area, or an attempt.

    The exact search comes first and is complete. So the result of a beam search is an attempt.

    Args:
        area: the outline, in units of the layout.
        layout: the tokens.
        seconds: processor time, at most.
    """
    tokens, begin = Tokens(layout), time.thread_time()
    budget, tried = Budget(begin + _SHARE * seconds), list[list[Laid]]()
    for tolerance in TOLERANCES:
        search = Search(tokens, tolerance * tokens.unit, budget)
        for laid in search.run(area):
            found = dissection(tokens, laid)
            iou = overlap(covered(layout, found), area)
            if iou >= SOLVED:
                passed = time.thread_time() - begin
                return Filled(found, iou, passed, budget.taken, False)
        tried.append(search.best)
        if budget.spent():
            break
    complete = not budget.spent()
    nearest, iou = nearest_fill(area, layout, Budget(begin + seconds), tried)
    return Filled(None, iou, time.thread_time() - begin, budget.taken, complete, nearest)


def nearest_fill(
    area: Area, layout: Layout, budget: Budget, tried: Sequence[list[Laid]]
) -> tuple[Dissection | None, float]:
    """The nearest dissection to an outline, of those tried and of beam searches; and its IoU."""
    tokens, every = Tokens(layout), [*tried]
    beam = Beam(tokens)
    for tolerance in _LOOSE:
        states = beam.run(area, tokens.counts, tolerance * tokens.unit, budget)
        every += [list(state.laid) for state in states[:1]]
    found = [dissection(tokens, laid) for laid in every if laid]
    if not found:
        return None, 0.0
    shares = [overlap(covered(layout, one), area) for one in found]
    # Area of tokens that lies on others counts against a dissection.
    twice = [
        sum(piece.area for piece in pieces(layout, one)) - covered(layout, one).area
        for one in found
    ]
    best = int(np.argmax(np.array(shares) - np.array(twice) / area.area))
    return found[best], shares[best]
