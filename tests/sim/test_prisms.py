"""Bodies for the engine: closed prisms, exact insets, and how thin a piece is."""

from collections import Counter

import numpy as np
import pytest
import shapely

from tangram_sim.prisms import inset, prism, thickness
from tangram_sim.shapes import SHAPE_NAMES, polygon_area, tan

pytestmark = pytest.mark.fast


@pytest.mark.parametrize("name", SHAPE_NAMES)
@pytest.mark.parametrize("depth", [0.0, 1e-4, 0.01])
def test_an_inset_is_shapelys(name: str, depth: float) -> None:
    corners = tan(name).corners
    expected = shapely.Polygon(corners).buffer(-depth, join_style="mitre", mitre_limit=100.0)
    assert shapely.Polygon(inset(corners, depth)).symmetric_difference(expected).area < 1e-12


@pytest.mark.parametrize("name", SHAPE_NAMES)
def test_a_prism_is_closed_and_has_its_volume(name: str) -> None:
    corners = tan(name).corners
    vertices, indices = prism(corners, 0.25)
    triangles = np.array(indices).reshape(-1, 3)
    edges = Counter((int(t[i]), int(t[i - 2])) for t in triangles for i in range(3))
    # Every edge is walked once in each direction: no hole, and one side is outside throughout.
    assert all(edges[b, a] == 1 == count for (a, b), count in edges.items())
    a, b, c = np.array(vertices)[triangles].swapaxes(0, 1)
    volume = (np.cross(a, b) * c).sum() / 6.0
    assert volume == pytest.approx(0.5 * polygon_area(corners))


def test_thickness_is_that_of_the_circle_inside() -> None:
    square = tan("square").corners
    assert thickness(square) == pytest.approx(2.0**0.5 / 8.0)
    triangle = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])
    assert thickness(triangle) == pytest.approx(1.0)
    beam = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 1.0], [0.0, 1.0]])
    assert thickness(beam) == pytest.approx(0.9)
