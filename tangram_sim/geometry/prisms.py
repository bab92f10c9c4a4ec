"""Convex polygons as bodies of the engine: prisms, inset polygons and thickness."""

import numpy as np

from tangram_core.arrays import Floats
from tangram_sim.geometry.shapes import polygon_area

ENGINE_ARENA = 2.0  # width of the arena in engine units


def prism(corners: Floats, half_height: float) -> tuple[list[list[float]], list[int]]:
    """Vertices and triangles of the prism over a convex counter-clockwise polygon (V, 2)."""
    count = len(corners)
    heights = (-half_height, half_height)
    vertices = [[float(x), float(y), z] for z in heights for x, y in corners]
    triangles: list[int] = []
    for i in range(1, count - 1):
        triangles += [count, count + i, count + i + 1, 0, i + 1, i]
    for i in range(count):
        j = (i + 1) % count
        triangles += [i, j, count + j, i, count + j, count + i]
    return vertices, triangles


def inset(corners: Floats, depth: float) -> Floats:
    """A convex counter-clockwise polygon (V, 2) with every edge moved inwards by `depth`.

    Valid if every edge keeps a positive length, as for a small part of the thickness.
    """
    edge = np.roll(corners, -1, axis=0) - corners
    inwards = np.stack([-edge[:, 1], edge[:, 0]], axis=1)
    inwards /= np.linalg.norm(edge, axis=1)[:, None]
    before = np.roll(inwards, 1, axis=0)
    cosine = (inwards * before).sum(axis=1)[:, None]
    moved: Floats = corners + depth * (inwards + before) / (1.0 + cosine)
    return moved


def thickness(corners: Floats) -> float:
    """Twice the area divided by the perimeter of a convex polygon (V, 2).

    This is the radius of the largest inner circle if the circle touches every edge, as in all
    triangles and squares. In every polygon it is less than the circle's diameter.
    """
    edge = np.roll(corners, -1, axis=0) - corners
    return float(2.0 * polygon_area(corners) / np.linalg.norm(edge, axis=1).sum())
