"""Fit poses of several tokens at once to all pixels of a picture.

Coverage rises like a ramp across an edge, over one pixel. Where tokens touch, coverages add up.
"""

from collections.abc import Sequence

import numpy as np

from tangram_core.arrays import Complex, Floats, Singles
from tangram_vision.pictures.kinds import Kind

_ROUNDS = 6
_STIFF = 1e-3
_LONGEST = 0.7  # pixels of one step, at most
_ENOUGH = 0.01  # pixels: a smaller step is the last one


def ramps(kinds: Sequence[Kind], poses: Floats, pixels: int) -> Floats:
    """Coverage (n, P, P) by each token; poses (n, 3) are in pixels."""
    z = _centres(pixels)
    return np.stack(
        [
            np.clip(_depth(kind, pose, z)[0], 0.0, 1.0).reshape(pixels, pixels)
            for kind, pose in zip(kinds, poses, strict=True)
        ]
    )


def fitted(kinds: Sequence[Kind], poses: Floats, cover: Singles) -> tuple[Floats, float]:
    """Poses (n, 3) by least squares, and their remaining difference, see `unlike`.

    Args:
        kinds: n kinds.
        poses: (n, 3) rough poses.
        cover: (P, P) coverage by these tokens.
    """
    seen, z = cover.ravel().astype(np.float64), _centres(len(cover))
    poses = poses.copy()
    # Turns are scaled so that a step of 1 moves a token's edges by about a pixel.
    size = np.array([np.sqrt(kind.area) / 2.0 for kind in kinds])
    for _ in range(_ROUNDS):
        rest, change = seen.copy(), np.empty((3 * len(kinds), len(z)))
        for n, (kind, pose) in enumerate(zip(kinds, poses, strict=True)):
            depth, edge = _depth(kind, pose, z)
            rest -= np.clip(depth, 0.0, 1.0)
            out = -1j * edge * ((depth > 0.0) & (depth < 1.0))
            place = z - complex(pose[0], pose[1])
            change[3 * n] = out.real
            change[3 * n + 1] = out.imag
            change[3 * n + 2] = (out.conj() * 1j * place).real / size[n]
        matrix = change @ change.T
        matrix += _STIFF * np.diag(np.diag(matrix)) + 1e-9 * np.eye(len(matrix))
        step = np.clip(np.linalg.solve(matrix, change @ rest), -_LONGEST, _LONGEST).reshape(-1, 3)
        step[:, 2] /= size
        poses += step
        if np.abs(step).max() < _ENOUGH:
            break
    return poses, unlike(kinds, poses, cover)


def unlike(kinds: Sequence[Kind], poses: Floats, cover: Singles) -> float:
    """The share of the tokens' area in which pixels differ; small differences count a tenth."""
    rest = np.abs(cover - ramps(kinds, poses, len(cover)).sum(axis=0))
    differs = rest[rest > 0.5].sum() + 0.1 * rest.sum()
    return float(differs / sum(kind.area for kind in kinds))


def _centres(pixels: int) -> Complex:
    side = np.arange(pixels) + 0.5
    return np.asarray(side - 1j * side[:, None]).ravel()


def _depth(kind: Kind, pose: Floats, z: Complex) -> tuple[Floats, Complex]:
    """Depth of points inside a shape, plus 0.5, and the direction of the nearest edge."""
    corners = kind.corners @ (1.0, 1j) * np.exp(1j * pose[2]) + complex(pose[0], pose[1])
    along = np.concatenate([corners[1:], corners[:1]]) - corners
    along /= np.abs(along)
    depths = np.outer(along.real, z.imag) - np.outer(along.imag, z.real)
    depths += 0.5 - (along.conj() * corners).imag[:, None]
    edge = depths.argmin(axis=0)
    return depths.min(axis=0), along[edge]
