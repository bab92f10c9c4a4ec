"""Areas that tokens cover or leave: polygons with holes, of several parts.

Points are complex numbers here, in whatever unit an area has.
"""

from typing import TypeAlias

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from tangram_core.arrays import Complex

Area: TypeAlias = "Polygon | MultiPolygon"

_ROUND = 1e-9  # of an area's size, to which corners are rounded where areas are intersected
_MITRE = 5.0  # of the sharpest corner, 45 degrees: 2.6


@np.errstate(invalid="ignore", divide="ignore")  # of corners all but within a straight side
def grown(area: Area, distance: float) -> Area:
    """An area with all sides so far further out, or in where the distance is negative."""
    return valid(shapely.buffer(area, distance, join_style="mitre", mitre_limit=_MITRE))


def valid(area: Area) -> Area:
    """The same area by rings that do not cross: what crosses breaks whatever is done with it."""
    if shapely.is_valid(area):
        return area
    return shapely.union_all(polygons(shapely.make_valid(area)))


def opened(area: Area, tolerance: float) -> Area:
    """An area without slivers narrower than two tolerances."""
    return grown(grown(area, -tolerance), tolerance)


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


def overlap(one: Area, other: Area) -> float:
    """Intersection over union of two areas."""
    size = _ROUND * float(np.sqrt(one.area + other.area))
    common = shapely.intersection(one, other, grid_size=size).area
    return float(common / max(one.area + other.area - common, 1e-300))


def rings(area: Area, tolerance: float) -> list[tuple[Complex, int, bool]]:
    """Each ring of an area: its corners (n,), the part it belongs to, and whether it is outside.

    Counter-clockwise, holes clockwise: the area lies to the left of every side.
    """
    found = []
    for part, polygon in enumerate(polygons(area)):
        every = ((polygon.exterior, True), *((hole, False) for hole in polygon.interiors))
        for ring, outer in every:
            z: Complex = np.asarray(ring.coords)[:-1] @ np.array([1.0, 1.0j])
            z = straightened(z if ring.is_ccw == outer else z[::-1], tolerance)
            if len(z) >= 3:
                found.append((z, part, outer))
    return found


def polygons(area: Area) -> list[Polygon]:
    """The parts of an area; none of an empty one."""
    parts = shapely.get_parts(area).tolist()
    return [one for one in parts if one.geom_type == "Polygon" and not one.is_empty]
