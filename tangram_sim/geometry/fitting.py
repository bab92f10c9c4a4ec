"""Fit of exact tans to hand-drawn corners, and separation of pieces that overlap.

All lengths are in units: the full square that the tans are cut from has side 1.
"""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from tangram_core.arrays import Floats
from tangram_sim.geometry.shapes import tan

# A piece may be turned over, but this changes only the parallelogram.
VARIANTS = {
    "large_triangle": ("large_triangle",),
    "medium_triangle": ("medium_triangle",),
    "small_triangle": ("small_triangle",),
    "square": ("square",),
    "parallelogram": ("parallelogram", "parallelogram_mirrored"),
}
KINDS = tuple(VARIANTS)
TOUCHING = 1e-9  # units; less is rounding
CLEARANCE = 1e-5  # units, gap between pieces after they are pushed apart
MAX_ROUNDS = 500  # a drawing accurate to 0.01 units takes up to 80


@dataclass(frozen=True, eq=False)
class Fit:
    """An exact tan fitted to a drawn piece.

    Attributes:
        shape: name of the tan; for a parallelogram the variant that fits better.
        pose: (3,) x, y (units) and angle (radians).
        residual: largest distance from a drawn corner to the tan's corner (units).
    """

    shape: str
    pose: Floats
    residual: float


def kind_of(name: str) -> str:
    """The kind of tan of a shape, on either side; the name itself if the shape is no tan."""
    return next((kind for kind, names in VARIANTS.items() if name in names), name)


def fit_piece(kind: str, corners: Floats) -> Fit:
    """The tan with the least squared distance to corners (V, 2), over all poses and assignments.

    `kind` is a key of `VARIANTS`. The corners may have any order and direction.
    """
    fits = [_fit_shape(name, corners) for name in VARIANTS[kind]]
    return min(fits, key=lambda pair: pair[0])[1]


def _fit_shape(name: str, corners: Floats) -> tuple[float, Fit]:
    """The sum of squared distances, and the fit."""
    # The mean of a tan's corners is its centre of area, so the best shift is known.
    body, centre = tan(name).corners @ (1.0, 1j), corners.mean(axis=0)
    drawn = ((corners - centre) @ (1.0, 1j))[list(permutations(range(len(corners))))]
    angle = np.angle((body.conj() * drawn).sum(axis=1))
    distance = np.abs(drawn - body * np.exp(1j * angle)[:, None])
    squares = (distance**2).sum(axis=1)
    # A symmetric shape fits equally well in several ways: take the first, despite rounding.
    best = int(np.flatnonzero(squares <= squares.min() + TOUCHING)[0])
    pose = np.array([*centre, angle[best]])
    return float(squares[best]), Fit(name, pose, float(distance[best].max()))


def overlap_depths(outlines: Floats) -> tuple[Floats, Floats]:
    """The depth of the overlap of every two pieces, and the direction of the shortest way apart.

    Args:
        outlines: (K, C, 2) convex and counter-clockwise, padded by repeating the last corner.

    Returns:
        depths (K, K), symmetric, not positive for pieces that are apart; and directions (K, K, 2),
        unit vectors along which piece j leaves piece i on the shortest way.
    """
    edge = np.roll(outlines, -1, axis=1) - outlines
    length = np.linalg.norm(edge, axis=-1, keepdims=True)
    normal = np.stack([edge[..., 1], -edge[..., 0]], axis=-1) / np.where(length > 0, length, 1.0)
    reach = (normal * outlines).sum(axis=-1)
    nearest = np.einsum("iex,jvx->ijev", normal, outlines).min(axis=-1)
    inside = np.where(length[:, None, :, 0] > 0, reach[:, None] - nearest, np.inf)
    edges = inside.argmin(axis=-1)
    depth, way = inside.min(axis=-1), normal[np.arange(len(outlines))[:, None], edges]
    np.fill_diagonal(depth, -np.inf)
    other = depth > depth.T
    return np.where(other, depth.T, depth), np.where(other[..., None], -way.swapaxes(0, 1), way)


def separate(outlines: Floats) -> Floats | None:
    """Shifts (K, 2) after which no two outlines (K, C, 2) overlap; None if none are found.

    In each round the two pieces with the deepest overlap are pushed apart, half the way each.
    Pieces are not rotated, and gaps are not closed.
    """
    shifts = np.zeros((len(outlines), 2))
    for _ in range(MAX_ROUNDS):
        depth, way = overlap_depths(outlines + shifts[:, None])
        i, j = np.unravel_index(depth.argmax(), depth.shape)
        if depth[i, j] <= TOUCHING:
            return shifts
        push = way[i, j] * (depth[i, j] + CLEARANCE) / 2.0
        shifts[i] -= push
        shifts[j] += push
    return None
