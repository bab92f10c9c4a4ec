"""The last parts of a pixel: poses by what each pixel beside an outline shows.

A binary picture tells of each pixel on which side of the outline its centre lies. Of all poses that
agree, one in the middle is the best guess.
"""

from collections.abc import Sequence

import numpy as np

from tangram_core.arrays import Complex, Floats, Ints, Singles
from tangram_vision.pictures.kinds import Kind

_BAND = 1.6  # pixels beside an outline
_WIDTHS = (0.35, 0.25, 0.18, 0.13, 0.1)  # pixels over which a side turns into the other
_STIFF = 1e-3


def binary(cover: Singles) -> bool:
    """Whether a picture's coverage has no level between ground and token."""
    return bool(((cover < 0.02) | (cover > 0.98)).all())


def settled(kinds: Sequence[Kind], poses: Floats, cover: Singles, base: Ints) -> Floats:
    """Poses (N, 3) that agree with the pixels of binary pictures; arguments as in edges.py."""
    owner, z, sign = _band(kinds, poses, cover, base)
    normal, reach = _edges(kinds)
    for width in _WIDTHS:
        turn = np.exp(1j * poses[:, 2])
        place = (z - (poses[:, 0] + 1j * poses[:, 1])[owner]) * turn.conj()[owner]
        depths = reach[owner] - (normal.conj()[owner] * place[:, None]).real
        edge = depths.argmin(axis=1)
        depth = depths[np.arange(len(z)), edge]
        # The inner product of an edge's normal with what a move does to the place.
        out = normal[owner, edge]
        change = np.column_stack([out.real, out.imag, (out.conj() * 1j * place).real])
        wrong = 1.0 / (1.0 + np.exp(np.clip(sign * depth / width, -30, 30)))
        slope, bend = sign * wrong / width, wrong * (1.0 - wrong) / width**2
        step = _solved(owner, len(poses), change, slope, bend)
        shift = (step[:, 0] + 1j * step[:, 1]) * turn
        poses = poses + np.column_stack([shift.real, shift.imag, step[:, 2]])
    return poses


def _solved(owner: Ints, count: int, change: Floats, slope: Floats, bend: Floats) -> Floats:
    """(N, 3) Newton's step of each token, bounded."""
    right = np.stack([np.bincount(owner, slope * c, count) for c in change.T], axis=1)
    products = bend[:, None, None] * change[:, :, None] * change[:, None]
    flat = products.reshape(-1, 9).T
    matrix = np.stack([np.bincount(owner, one, count) for one in flat], axis=1)
    matrix = matrix.reshape(-1, 3, 3)
    matrix += (_STIFF * np.trace(matrix, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(3)
    step = np.linalg.solve(matrix, right[..., None])[..., 0]
    return np.clip(step, -0.3, 0.3)


def _band(
    kinds: Sequence[Kind], poses: Floats, cover: Singles, base: Ints
) -> tuple[Ints, Complex, Floats]:
    """Pixels beside the outlines: their tokens, centres, and 1 for a token or -1 for ground."""
    pixels = cover.shape[1]
    owners, centres, signs = [], [], []
    for n, kind in enumerate(kinds):
        radius = float(np.hypot(*kind.corners.T).max()) + _BAND
        columns = _range(poses[n, 0], radius, pixels)
        rows = _range(-poses[n, 1], radius, pixels)
        z = (columns + 0.5) - 1j * (rows + 0.5)[:, None]
        normal, reach = _edges([kind])
        place = (z - complex(poses[n, 0], poses[n, 1])) * np.exp(-1j * poses[n, 2])
        depth = (reach[0] - (normal[0].conj() * place[..., None]).real).min(axis=-1)
        row, column = np.nonzero(np.abs(depth) < _BAND)
        shown = cover[base[n] + rows[row], columns[column]] > 0.5
        owners.append(np.full(len(row), n))
        centres.append(z[row, column])
        signs.append(np.where(shown, 1.0, -1.0))
    return np.concatenate(owners), np.concatenate(centres), np.concatenate(signs)


def _range(middle: float, radius: float, pixels: int) -> Ints:
    low, high = int(max(0, middle - radius)), int(min(pixels, middle + radius + 1))
    return np.arange(min(low, pixels - 1), max(high, 1))


def _edges(kinds: Sequence[Kind]) -> tuple[Complex, Floats]:
    """Unit normals (N, C) as complex numbers, and distances (N, C) of edges from the centre."""
    most = max(len(kind.corners) for kind in kinds)
    normal, reach = np.zeros((len(kinds), most), complex), np.full((len(kinds), most), np.inf)
    for n, kind in enumerate(kinds):
        z = kind.corners @ (1.0, 1j)
        edge = np.roll(z, -1) - z
        own = -1j * edge / np.abs(edge)
        normal[n, : len(z)], reach[n, : len(z)] = own, (own.conj() * z).real
    return normal, reach
