"""Tokens that touch, told apart by where they lay before: most of them have not moved since.

No search tells so many tokens apart as lie in a finished figure. But one that stayed covers the
same pixels as before, so that only what is left of the picture must be explained.

Legend: K tokens, n of them in piles.
"""

from collections.abc import Sequence

import numpy as np

from tangram_core.arrays import Bools, Floats, Singles
from tangram_sim.sight.perception import Look
from tangram_vision.pictures.kinds import Kind
from tangram_vision.pictures.ramps import ramps

_WHOLE = 0.999  # coverage of a pixel that lies within a token
_COVERED = 0.9  # share of these pixels that a token which stayed covers still


def recalled(
    kinds: Sequence[Kind], before: Look, arena: float, piles: Singles
) -> tuple[list[int], Floats]:
    """Which kinds (n,) still lie in piles, and their poses (n, 3) in pixels, as they were before.

    Args:
        kinds: all of the layout.
        before: where its tokens (K,) lay.
        arena: width of the picture.
        piles: (P, P) coverage by tokens that touch.
    """
    pixels = len(piles)
    unit, corner = pixels / arena, (pixels / 2.0, -pixels / 2.0, 0.0)
    poses = before.poses * (unit, unit, 1.0) + corner
    names = [
        next(n for n, kind in enumerate(kinds) if token in kind.tokens and kind.flipped == side)
        for token, side in enumerate(before.flipped.tolist())
    ]
    stay = before.sure & _covers([kinds[n] for n in names], poses, piles)
    return [names[token] for token in np.flatnonzero(stay)], poses[stay]


def _covers(kinds: Sequence[Kind], poses: Floats, piles: Singles) -> Bools:
    """(K,) tokens whose own pixels are covered."""
    inside = ramps(kinds, poses, len(piles)) > _WHOLE
    covered = (inside & (piles > 0.5)).sum(axis=(1, 2))
    return np.asarray(covered >= _COVERED * np.maximum(inside.sum(axis=(1, 2)), 1))
