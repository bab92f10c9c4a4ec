"""Areas that tokens cover or leave free: polygons of several parts, with holes.

Points are complex numbers here, in the unit of their area.
"""

from typing import TypeAlias

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from tangram_core.arrays import Complex

Area: TypeAlias = "Polygon | MultiPolygon"

_ROUND = 1e-9  # grid for the corners of an intersection, as a share of the areas' size
_MITRE = 5.0  # largest mitre ratio; the sharpest corner, 45 degrees, needs 2.6


@np.errstate(invalid="ignore", divide="ignore")  # at corners that are nearly straight
def grown(area: Area, distance: float) -> Area:
    """An area with all sides moved outwards by a distance, or inwards by a negative one."""
    return valid(shapely.buffer(area, distance, join_style="mitre", mitre_limit=_MITRE))


def valid(area: Area) -> Area:
    """The same area with rings that do not cross: other functions need such rings."""
    if shapely.is_valid(area):
        return area
    return shapely.union_all(polygons(shapely.make_valid(area)))


def opened(area: Area, tolerance: float) -> Area:
    """An area without slivers narrower than two tolerances."""
    return grown(grown(area, -tolerance), tolerance)


def straightened(z: Complex, tolerance: float) -> Complex:
    """Corners (n,) of a ring, without repeated ones and those within a straight side."""
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
    """The rings of an area: corners (n,), number of the part, and whether it is an outer ring.

    Outer rings are counter-clockwise, holes clockwise: the area lies to the left of every side.
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
    """The parts of an area; an empty list for an empty area."""
    parts = shapely.get_parts(area).tolist()
    return [one for one in parts if one.geom_type == "Polygon" and not one.is_empty]
