"""A target without its pieces: the outline of what they cover, as rows of corners that travel.

Ring after ring, each closed by its first corner; rows that are left over repeat the last one. A
ring within another is a hole. Legend: V corners of all tokens, K tokens, G rows.
"""

from functools import reduce

import numpy as np
import shapely
from shapely import Polygon

from tangram_core.arrays import AnyArray, Bools, Floats
from tangram_core.errors import ConfigError
from tangram_sim.geometry.areas import Area, grown, rings, valid
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines

_SEAM = 0.002  # of the root of all tokens' area: half of the gaps between pieces that are closed
_STRAIGHT = 0.002  # of it: corners that are less off a straight side are none
_GRID = 1e-7  # of it, to which corners are rounded


def covered_area(corners: Floats, layout: Layout, tokens: Bools | None = None) -> Area:
    """What tokens with corners (V, 2) cover together, gaps closed.

    `tokens` (K,) are those that count; None: all do.
    """
    pieces = outlines(np.asarray(corners, np.float64)[None], layout)[0]
    counted = pieces if tokens is None else pieces[tokens]
    size = unit_of(layout)
    own = [Polygon(one) for one in counted]
    whole = shapely.union_all(own, grid_size=_GRID * size)
    return grown(grown(whole, _SEAM * size), -_SEAM * size)


def unit_of(layout: Layout) -> float:
    """The root of all tokens' area, the side of the full square that tans are cut from."""
    return float(np.sqrt(layout.areas.sum()))


def as_rows(area: Area, layout: Layout, most: int) -> Floats:
    """Corners (G, 2) of an area's rings, `most` of them; ConfigError if it has too many."""
    # Where rings begin is not to tell of the pieces.
    every = [z for z, _, _ in rings(shapely.normalize(area), _STRAIGHT * unit_of(layout))]
    joined = np.concatenate([np.append(z, z[0]) for z in every]) if every else np.zeros(1, complex)
    if len(joined) > most:
        raise ConfigError(
            f"an outline of these tokens has at most {most} corners, one for each ring counted "
            f"twice, got {len(joined)}: draw straight sides"
        )
    joined = np.append(joined, np.full(most - len(joined), joined[-1]))
    return np.column_stack([joined.real, joined.imag])


def as_area(rows: AnyArray) -> Area:
    """The area of rows (G, 2), whatever they hold; empty where they enclose nothing."""
    found, first, points = [], 0, np.asarray(rows, np.float64)
    while first < len(points):
        closed = np.flatnonzero((points[first + 1 :] == points[first]).all(axis=1))
        if not len(closed):
            break
        last = first + 1 + int(closed[0])
        if last - first >= 3:
            found.append(valid(Polygon(points[first : last + 1])))
        first = last + 1
    # A ring within a ring is a hole.
    return valid(reduce(shapely.symmetric_difference, found, Polygon()))
