"""The seven tans, polygons of the user's own, and their bodies for the engine."""

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_core.errors import ConfigError
from tangram_sim.geometry.prisms import inset, prism, thickness
from tangram_sim.geometry.shapes import (
    SHAPE_NAMES,
    Shape,
    polygon,
    polygon_area,
    polygon_centroid,
    tan,
)
from tests.sim.builders import SEVEN

pytestmark = pytest.mark.fast

R, E = math.sqrt(2.0), 1 / 8
# name: area, symmetry order, corners for a full square of side 1, centre of area at the origin
TANS = {
    "large_triangle": (1 / 4, 1, [(-R / 6, -R / 6), (R / 3, -R / 6), (-R / 6, R / 3)]),
    "medium_triangle": (1 / 8, 1, [(-1 / 6, -1 / 6), (1 / 3, -1 / 6), (-1 / 6, 1 / 3)]),
    "small_triangle": (1 / 16, 1, [(-R / 12, -R / 12), (R / 6, -R / 12), (-R / 12, R / 6)]),
    "square": (1 / 8, 4, [(-R / 8, -R / 8), (R / 8, -R / 8), (R / 8, R / 8), (-R / 8, R / 8)]),
    "parallelogram": (1 / 8, 2, [(-3 / 8, -E), (E, -E), (3 / 8, E), (-E, E)]),
    "parallelogram_mirrored": (1 / 8, 2, [(-E, -E), (3 / 8, -E), (E, E), (-3 / 8, E)]),
}


@pytest.mark.parametrize("name", TANS)
def test_tan(name: str) -> None:
    area, symmetry, corners = TANS[name]
    shape = tan(name)
    assert shape.name == name
    assert shape.area == pytest.approx(area, abs=1e-15)
    assert shape.symmetry == symmetry
    np.testing.assert_allclose(shape.corners, corners, atol=1e-15)
    np.testing.assert_allclose(polygon_centroid(shape.corners), 0.0, atol=1e-15)
    assert shape.radius == pytest.approx(max(math.hypot(x, y) for x, y in corners))


def test_seven_tans_fill_the_full_square() -> None:
    assert set(TANS) == set(SHAPE_NAMES)
    assert sum(tan(name).area for name in SEVEN) == pytest.approx(1.0, abs=1e-15)


def _regular(corners: int) -> list[list[float]]:
    angles = [2 * math.pi * i / corners for i in range(corners)]
    return [[math.cos(a), math.sin(a)] for a in angles]


@pytest.mark.parametrize(
    ("corners", "symmetry"),
    [
        (_regular(3), 3),
        (_regular(4), 4),
        (_regular(6), 6),
        (_regular(16), 16),
        ([[0, 0], [2, 0], [2, 1], [0, 1]], 2),
        ([[0, 0], [4, 0], [3, 1], [0, 2]], 1),
        ([[0, -1], [1, 0], [0, 3], [-1, 0]], 1),  # a kite
        # Threefold, with corners at two radii.
        ([[c * r for c in p] for p, r in zip(_regular(6), [1, 0.9] * 3, strict=True)], 3),
    ],
)
def test_symmetry_order_of_own_polygons(corners: list[list[float]], symmetry: int) -> None:
    assert polygon("own", corners).symmetry == symmetry


def test_clockwise_and_shifted_polygon_becomes_the_same_shape() -> None:
    corners = np.array([[0, 0], [4, 0], [3, 1], [0, 2]], dtype=float)
    shifted = polygon("own", (corners[::-1] + np.array([7.0, -3.0])).tolist())
    assert polygon_area(shifted.corners) > 0
    np.testing.assert_allclose(polygon_centroid(shifted.corners), 0.0, atol=1e-12)
    assert shifted.area == pytest.approx(polygon("own", corners.tolist()).area)


def test_size_and_unit_do_not_change_the_form() -> None:
    shape = tan("parallelogram").scaled(3.0)
    assert (shape.symmetry, shape.area) == (2, pytest.approx(9 / 8))
    tiny = polygon("own", [[0, 0], [1e-6, 0], [0, 1e-6]])
    assert tiny.area == pytest.approx(5e-13)


@pytest.mark.parametrize(
    ("corners", "reason"),
    [
        ([[0, 0], [1, 0]], "3 to 16 pairs"),
        (_regular(17), "3 to 16 pairs"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "3 to 16 pairs"),
        ([[0, 0], [1, 0], [0]], "3 to 16 pairs"),
        ("square", "3 to 16 pairs"),
        (None, "3 to 16 pairs"),
        ([[0, 0], [1, 0], [0, math.nan]], "finite"),
        ([[0, 0], [1, 0], [0, math.inf]], "finite"),
        ([[0, 0], [2, 0], [0.5, 0.5], [0, 2]], "strictly convex"),  # concave
        ([[0, 0], [1, 0], [1, 0], [0, 1]], "strictly convex"),  # repeated
        ([[0, 0], [1, 0], [2, 0], [0, 1]], "strictly convex"),  # collinear
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "strictly convex"),  # crossing
        ([_regular(5)[i] for i in (0, 2, 4, 1, 3)], "strictly convex"),  # a star turns left only
    ],
)
def test_refused_polygon(corners: list[list[float]], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        polygon("own", corners)


@given(st.floats(-math.pi, math.pi), st.sampled_from(SHAPE_NAMES))
@settings(max_examples=50)
def test_a_turned_polygon_is_the_same_shape(angle: float, name: str) -> None:
    shape: Shape = tan(name)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    turned = polygon("own", (shape.corners @ turn.T).tolist())
    assert (turned.symmetry, turned.area) == (shape.symmetry, pytest.approx(shape.area))


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


@pytest.mark.parametrize(
    ("corners", "size"),
    [
        (tan("square").corners, 2.0**0.5 / 8.0),
        ([[0, 0], [4, 0], [0, 3]], 1.0),
        ([[0, 0], [9, 0], [9, 1], [0, 1]], 0.9),
    ],
)
def test_thickness_is_that_of_the_circle_inside(corners: Any, size: float) -> None:
    assert thickness(np.array(corners, dtype=float)) == pytest.approx(size)
