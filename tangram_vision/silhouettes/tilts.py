"""Correct a photograph of a silhouette that was taken at an angle.

Sides of touching tans run at multiples of 45 degrees to each other. In a photograph at an angle
they do not: one direction is shortened, and distant parts are smaller. Least squares finds the
camera position that brings the sides back onto one such grid. Then the picture is changed to the
view from above. If no position fits the sides well, the picture is left as it is.

Points are (..., 2) columns and rows of pixels here. Legend: P pixels along a side of a picture, S
sides of the silhouette.
"""

import cv2
import numpy as np
import shapely
from scipy.optimize import least_squares

from tangram_core.arrays import Floats, Singles
from tangram_sim.geometry.areas import straightened
from tangram_vision.silhouettes.outlines import Way, outline

_PIXELS = 256  # along a side of the picture whose sides are looked at
_WAY = Way(spread=0.15, cost=20.0, grid=False)
_SHORT = 8.0  # pixels: shorter sides give no direction
_STRAY = 0.5  # pixels: usual error of the ends of sides
_LEAST = 6  # sides, at least, for four unknowns
# Start values of the unknowns of `_matrix`, and their usual distances from these.
_START, _USUAL = np.array([0.0, 0.0, np.log(3.0)]), np.array([0.1, 0.1, 0.3])
_MOST = 0.2  # change of scale over half of the silhouette, at most: a near camera tilted by 30°
_OFF = np.radians(0.5)  # mean error of sides on the grid: a smaller one is not corrected
_REST = 0.25  # share of that error that may remain
_MARGIN = 8  # pixels around the silhouette


def from_above(cover: Singles) -> tuple[Singles, Floats]:
    """Coverage (P, P) as seen from straight above, of about the same area.

    Returns:
        The coverage (Q, Q), and the homography (3, 3) from its points to those of the given
        picture; pixels begin at whole numbers. Without a correction, the picture itself and the
        identity.
    """
    size = len(cover)
    small = cv2.resize(cover, (min(size, _PIXELS),) * 2, interpolation=cv2.INTER_AREA)
    sides = _sides(np.asarray(small, np.float32)) * (size / len(small))
    correction = _correction(sides) if len(sides) >= _LEAST else None
    if correction is None:
        return cover, np.eye(3)
    matrix, side = _placed(correction, sides)
    above = np.asarray(cv2.warpPerspective(cover, matrix, (side, side)), np.float32)
    # In OpenCV the centres of pixels are whole numbers.
    return above, shift(0.5, 0.5) @ np.linalg.inv(matrix) @ shift(-0.5, -0.5)


def shift(right: float, down: float) -> Floats:
    """The homography (3, 3) that moves points by `right` and `down`."""
    return np.array([[1.0, 0.0, right], [0.0, 1.0, down], [0.0, 0.0, 1.0]])


def mapped(matrix: Floats, points: Floats) -> Floats:
    """Points (..., 2) after a homography (3, 3)."""
    there = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1) @ matrix.T
    found: Floats = there[..., :2] / there[..., 2:]
    return found


def _sides(cover: Singles) -> Floats:
    """(S, 2, 2) ends of the silhouette's sides in coverage (P, P)."""
    rings = [
        straightened(np.asarray(ring.coords)[:-1] @ np.array([1.0, 1j]), 1.0)
        for part in shapely.get_parts(outline(cover, _WAY)).tolist()
        for ring in (part.exterior, *part.interiors)
    ]
    if not rings:
        return np.zeros((0, 2, 2))
    z = np.concatenate([np.stack([ring, np.roll(ring, -1)], axis=1) for ring in rings])
    z = z[np.abs(z[:, 1] - z[:, 0]) > _SHORT]
    return np.stack([z.real, -z.imag], axis=-1)


def _correction(sides: Floats) -> Floats | None:
    """The homography (3, 3) that brings sides onto a grid; None if no good one is found."""
    low, high = sides.min(axis=(0, 1)), sides.max(axis=(0, 1))
    middle, reach = (low + high) / 2.0, float((high - low).max()) / 2.0
    own = (sides - middle) / reach
    length = np.hypot(*(sides[:, 1] - sides[:, 0]).T)
    weight = length / _STRAY
    start = np.append(_START, _grid(own, length))

    def off(unknown: Floats) -> Floats:
        return _off(mapped(_matrix(unknown[:3]), own), unknown[3])

    def residuals(unknown: Floats) -> Floats:
        return np.concatenate([off(unknown) * weight, (unknown[:3] - _START) / _USUAL])

    found = least_squares(residuals, start, loss="soft_l1").x
    before, after = (
        float(np.average(np.abs(off(unknown)), weights=length)) for unknown in (start, found)
    )
    if before < _OFF or after > _REST * before or np.hypot(*found[:2]) > _MOST:
        return None
    into = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, reach]]) / reach
    back: Floats = np.linalg.inv(into) @ _matrix(found[:3]) @ into
    return back


def _matrix(unknown: Floats) -> Floats:
    """The homography that undoes a tilt; half of the silhouette's width is 1.

    Args:
        unknown: change of scale to the right and down, and the log of the camera's distance.
    """
    right, down, far = unknown
    # A tilt by a changes the scale by a / distance, and shortens by a^2 / 2 along the same way.
    x, y = np.array([right, down]) * np.exp(far) / 2.0
    return np.array(
        [[1.0 + x * x - y * y, 2.0 * x * y, 0.0], [2.0 * x * y, 1.0 - x * x + y * y, 0.0]]
        + [[right, down, 1.0]]
    )


def _grid(sides: Floats, length: Floats) -> float:
    """The angle of the grid that is nearest to sides (S, 2, 2)."""
    along = (sides[:, 1] - sides[:, 0]) @ np.array([1.0, 1j])
    return float(np.angle((length * (along / np.abs(along)) ** 8).sum()) / 8.0)


def _off(sides: Floats, grid: float) -> Floats:
    """(S,) angles between sides and the nearest direction of the grid."""
    along = (sides[:, 1] - sides[:, 0]) @ np.array([1.0, 1j])
    off: Floats = np.angle((along / np.abs(along) * np.exp(-1j * grid)) ** 8) / 8.0
    return off


def _placed(matrix: Floats, sides: Floats) -> tuple[Floats, int]:
    """The homography into a square around the silhouette, and the square's pixels."""
    ends = mapped(matrix, sides)
    low, high = ends.min(axis=(0, 1)), ends.max(axis=(0, 1))
    side = int(np.ceil((high - low).max())) + 2 * _MARGIN
    left, top = np.round((low + high - side) / 2.0).tolist()
    return shift(-left, -top) @ matrix, side
