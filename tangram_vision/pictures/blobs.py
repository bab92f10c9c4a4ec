"""Connected areas of coverage ("blobs"), and their likeness to shapes by moments."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tangram_core.arrays import Bools, Complex, Floats, Ints, Singles
from tangram_vision.pictures.kinds import ORDERS, POWERS, Kind

_HALO = 3.0  # pixels around a blob that may still belong to it
_MOST_ROWS = 32767  # of all blobs stacked: OpenCV samples no taller picture
_TURNS: Floats = np.linspace(-np.pi, np.pi, 120, endpoint=False)
_TURNED: Complex = np.exp(1j * _TURNS[:, None] * ORDERS)
# Higher moments are noisier, and count less.
_WEIGHTS: Floats = np.array([4.0, 6.0, 4.0, 3.0, 3.0])


@dataclass(frozen=True, eq=False)
class Blobs:
    """N connected areas of a picture.

    Attributes:
        cover: (N * P, P) coverage by each blob alone, one picture below the other.
        area: (N,) areas in square pixels.
        centre: (N,) centres x + iy in pixels from the upper left corner, y up.
        moments: (N, F) moments, see kinds.py.
        cut: (N,) whether a blob reaches the picture's edge.
    """

    cover: Singles
    area: Floats
    centre: Complex
    moments: Complex
    cut: Bools

    def __len__(self) -> int:
        return len(self.area)

    @property
    def base(self) -> Ints:
        """(N,) the first row of each blob in `cover`."""
        rows: Ints = np.arange(len(self)) * self.cover.shape[1]
        return rows


def find_blobs(cover: Singles, smallest: float) -> Blobs:
    """The blobs of coverage (P, P) of at least `smallest` square pixels, the largest first.

    The number of blobs is limited; the limit is far above any number of tokens.
    """
    pixels = len(cover)
    ground = (cover < 0.5).astype(np.uint8)
    distance, label = cv2.distanceTransformWithLabels(
        ground, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_CCOMP
    )
    near = distance < _HALO
    label = np.where(near, label, 0).ravel()
    rows = np.flatnonzero(label)
    own, weight = label[rows], cover.ravel()[rows].astype(np.float64)
    area = np.bincount(own, weight)
    kept = [i for i in np.argsort(-area, kind="stable").tolist() if area[i] >= smallest]
    del kept[_MOST_ROWS // pixels :]
    if not kept:
        none = np.zeros((0, len(POWERS)), np.complex128)
        return Blobs(cover[:0], np.zeros(0), none[:, 0], none, np.zeros(0, np.bool_))
    number = np.full(len(area), -1)
    number[kept] = np.arange(len(kept))
    blob = number[own]
    rows, weight, blob = rows[blob >= 0], weight[blob >= 0], blob[blob >= 0]
    alone = np.zeros((len(kept), pixels * pixels), np.float32)
    alone[blob, rows] = weight
    row, column = np.divmod(rows, pixels)
    z = (column + 0.5) - 1j * (row + 0.5)
    areas = area[kept].astype(np.float64)
    centre = _sums(blob, weight * z) / areas
    moments = _moments(z - centre[blob], weight, blob, areas)
    border = (row == 0) | (row == pixels - 1) | (column == 0) | (column == pixels - 1)
    cut = np.bincount(blob, border & (weight > 0.5), minlength=len(kept)) > 0
    return Blobs(alone.reshape(-1, pixels), areas, centre, moments, cut)


def likeness(moments: Complex, kinds: Sequence[Kind]) -> tuple[Floats, Floats]:
    """Distances between moments of blobs and kinds, and the turns that make them smallest.

    Args:
        moments: (N, F) moments of the blobs.
        kinds: S kinds.

    Returns:
        (N, S) distances, 0 for the shape itself, and (N, S) turns in radians.
    """
    own = np.array([kind.moments for kind in kinds])
    # |b - e^(i n t) s|^2 = |b|^2 + |s|^2 - 2 Re(b conj(s) e^(-i n t)), for all turns at once.
    both = (_WEIGHTS * moments[:, None] * own.conj()) @ _TURNED.conj().T
    alike = both.real
    best = alike.argmax(axis=2)
    squares = (_WEIGHTS * np.abs(moments) ** 2).sum(axis=1)[:, None]
    squares = squares + (_WEIGHTS * np.abs(own) ** 2).sum(axis=1)
    most = np.take_along_axis(alike, best[..., None], axis=2)[..., 0]
    far: Floats = np.sqrt(np.maximum(squares - 2.0 * most, 0.0))
    return far, _TURNS[best]


def _sums(blob: Ints, values: Complex) -> Complex:
    return np.bincount(blob, values.real) + 1j * np.bincount(blob, values.imag)


def _moments(z: Complex, weight: Floats, blob: Ints, area: Floats) -> Complex:
    square, length = z * z, (z * z.conj()).real
    products = {
        (2, 0): square,
        (3, 0): square * z,
        (4, 0): square * square,
        (2, 1): z * length,
        (3, 1): square * length,
    }
    columns = [
        _sums(blob, weight * products[power]) / area ** (1 + sum(power) / 2) for power in POWERS
    ]
    return np.stack(columns, axis=1)
