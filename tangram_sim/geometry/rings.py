"""Outlines of targets as rows of corners: conversion from areas, and back.

Rows hold ring after ring, each closed by its first corner. Unused rows repeat the last one. A ring
within another is a hole. Legend: V corners of all tokens, K tokens, G rows.
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

# All as shares of the square root of the tokens' total area.
_SEAM = 0.002  # half the width of the widest gap between pieces that is closed
_STRAIGHT = 0.002  # corners nearer to a straight side are left out
_GRID = 1e-7  # grid for corners


def covered_area(corners: Floats, layout: Layout, tokens: Bools | None = None) -> Area:
    """The area that tokens with corners (V, 2) cover together, with narrow gaps closed.

    `tokens` (K,) marks the tokens that count; None: all.
    """
    pieces = outlines(np.asarray(corners, np.float64)[None], layout)[0]
    counted = pieces if tokens is None else pieces[tokens]
    size = unit_of(layout)
    own = [Polygon(one) for one in counted]
    whole = shapely.union_all(own, grid_size=_GRID * size)
    return grown(grown(whole, _SEAM * size), -_SEAM * size)


def unit_of(layout: Layout) -> float:
    """Square root of the tokens' total area: the side of the full square of the tans."""
    return float(np.sqrt(layout.areas.sum()))


def as_rows(area: Area, layout: Layout, most: int) -> Floats:
    """Corners of an area's rings as rows (`most`, 2); ConfigError if there are too many."""
    # Normalised: the first corner of a ring must not give away the pieces.
    every = [z for z, _, _ in rings(shapely.normalize(area), _STRAIGHT * unit_of(layout))]
    joined = np.concatenate([np.append(z, z[0]) for z in every]) if every else np.zeros(1, complex)
    if len(joined) > most:
        raise ConfigError(
            f"an outline of these tokens has at most {most} corners, counting the first corner of "
            f"each ring twice, got {len(joined)}: draw straight sides"
        )
    joined = np.append(joined, np.full(most - len(joined), joined[-1]))
    return np.column_stack([joined.real, joined.imag])


def as_area(rows: AnyArray) -> Area:
    """The area that rows (G, 2) of any numbers enclose; empty if they enclose none."""
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
