"""The seven tans and user-defined convex polygons.

Every shape is a convex polygon in its body frame: corners counter-clockwise, origin at the centre
of area. The tans are exact for a full square of side 1, so their areas are 1/4, 1/8 and 1/16.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError

MAX_CORNERS = 16
MAX_COORDINATE = 1e6
_TOLERANCE = 1e-9  # radians


@dataclass(frozen=True, eq=False)
class Shape:
    """A convex polygon in its body frame.

    Attributes:
        name: as the user gives it.
        corners: (V, 2), counter-clockwise, centre of area at the origin.
        symmetry: number of rotations in [0, 2*pi) that map the polygon onto itself.
    """

    name: str
    corners: Floats = field(repr=False)
    symmetry: int

    @cached_property
    def area(self) -> float:
        """Area, in squared units of the corners."""
        return polygon_area(self.corners)

    @cached_property
    def radius(self) -> float:
        """Distance of the farthest corner from the centre."""
        return float(np.linalg.norm(self.corners, axis=1).max())

    @cached_property
    def mirror(self) -> float | None:
        """The angle that rotates the shape onto its mirror image (x, -y); None if none does.

        A shape without such an angle is chiral.
        """
        return turn_onto(self.corners, mirror_image(self.corners))

    def scaled(self, scale: float) -> "Shape":
        """The same shape, `scale` times as large."""
        return Shape(self.name, self.corners * scale, self.symmetry)


def polygon_area(corners: Floats) -> float:
    """Signed area of one polygon (V, 2): positive when counter-clockwise."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2.0)


def polygon_centroid(corners: Floats) -> Floats:
    """Centre of area, (2,), of one polygon (V, 2)."""
    ahead = np.roll(corners, -1, axis=0)
    cross = corners[:, 0] * ahead[:, 1] - ahead[:, 0] * corners[:, 1]
    centroid: Floats = ((corners + ahead) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())
    return centroid


def mirror_image(corners: Floats) -> Floats:
    """The mirror image (x, -y) of corners (V, 2); both are counter-clockwise."""
    image: Floats = corners[::-1] * (1.0, -1.0)
    return image


def turn_onto(corners: Floats, image: Floats) -> float | None:
    """The angle that rotates corners (V, 2) onto an image (V, 2); None if none does.

    Both are counter-clockwise around the origin, and may begin with different corners.
    """
    if len(corners) != len(image):
        return None
    body, wanted = corners @ (1.0, 1j), image @ (1.0, 1j)
    for shift in range(len(body)):
        rolled = np.roll(wanted, shift)
        turn = rolled[0] / body[0]
        turn /= abs(turn)  # a rotation only: a shape of another size is not equal
        if np.allclose(rolled, turn * body, rtol=0.0, atol=1e-6 * np.abs(body).max()):
            return float(np.angle(turn))
    return None


def polygon(name: str, corners: Sequence[Sequence[float]]) -> Shape:
    """A user's shape of 3 to 16 corners, in either direction; ConfigError unless convex."""
    points = _checked_points(name, corners)
    if polygon_area(points) < 0:
        points = points[::-1]
    _check_convex(name, points)
    points = points - polygon_centroid(points)
    return Shape(name, points, _symmetry_order(points))


def _checked_points(name: str, corners: Sequence[Sequence[float]]) -> Floats:
    try:
        points = np.asarray(corners, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.empty((0, 0))
    if points.ndim != 2 or points.shape[1] != 2 or not 3 <= len(points) <= MAX_CORNERS:
        raise ConfigError(
            f"shape '{name}': corners must be a list of 3 to {MAX_CORNERS} pairs [x, y], "
            f"got {corners!r}"
        )
    if not (np.abs(points) <= MAX_COORDINATE).all():
        raise ConfigError(
            f"shape '{name}': corners must be finite and within +-{MAX_COORDINATE:g}, "
            f"got {corners!r}"
        )
    return points


def _check_convex(name: str, points: Floats) -> None:
    edge = np.roll(points, -1, axis=0) - points
    ahead = np.roll(edge, -1, axis=0)
    turn = edge[:, 0] * ahead[:, 1] - edge[:, 1] * ahead[:, 0]
    angles = np.arctan2(turn, np.sum(edge * ahead, axis=1))
    if (angles <= _TOLERANCE).any() or not np.isclose(angles.sum(), 2 * np.pi):
        raise ConfigError(
            f"shape '{name}' is not a strictly convex polygon: list its corners in order around "
            f"the outline, without repeated or collinear ones, got {points.tolist()}"
        )


def _symmetry_order(points: Floats) -> int:
    """The largest k for which a rotation by 2*pi/k maps the corners onto themselves."""
    count = len(points)
    as_complex = points[:, 0] + 1j * points[:, 1]
    orders = (k for k in range(count, 1, -1) if count % k == 0)
    for k in orders:
        turned = as_complex * np.exp(2j * np.pi / k)
        if np.allclose(turned, np.roll(as_complex, -count // k), atol=1e-6 * abs(as_complex).max()):
            return k
    return 1


_Q = np.sqrt(2.0) / 4.0  # side of the small square of a full square with side 1

_TANS: dict[str, list[tuple[float, float]]] = {
    "large_triangle": [(0, 0), (2 * _Q, 0), (0, 2 * _Q)],
    "medium_triangle": [(0, 0), (0.5, 0), (0, 0.5)],
    "small_triangle": [(0, 0), (_Q, 0), (0, _Q)],
    "square": [(0, 0), (_Q, 0), (_Q, _Q), (0, _Q)],
    "parallelogram": [(0, 0), (0.5, 0), (0.75, 0.25), (0.25, 0.25)],
    "parallelogram_mirrored": [(0, 0), (0.5, 0), (0.25, 0.25), (-0.25, 0.25)],
}

SHAPE_NAMES = tuple(_TANS)


def tan(name: str) -> Shape:
    """A tan by name, cut from a full square of side 1; ConfigError for an unknown name."""
    if name not in _TANS:
        raise ConfigError(
            f"unknown shape '{name}': choose from {', '.join(SHAPE_NAMES)}, "
            "or define one as {name: ..., corners: [[x, y], ...]}"
        )
    return polygon(name, _TANS[name])
