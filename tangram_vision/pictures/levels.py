"""From levels of gray to coverage: which share of each pixel tokens cover.

Legend of this package: P pixels along a side of a picture, K tokens, N blobs. Coverage is (P, P)
float32, about 0 where a picture shows the ground and about 1 where it shows a token. Light may fall
off evenly across the picture; tokens may be darker than the ground or lighter.
"""

import cv2
import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels, Singles

MIN_CONTRAST = 40  # levels between ground and tokens; less is taken for noise
_EVEN = 1.0  # levels of deviation up to which the ground is taken to be lit evenly
_SPARSE = 3  # every so many rows and columns tell the light
_FEW = 12  # pixels that are enough to tell the level of tokens
_DEEP = 0.02
_CLEAR = cv2.getStructuringElement(cv2.MORPH_RECT, (7, 7))


def coverage(picture: Pixels) -> Singles | None:
    """(P, P) of a picture (P, P); None if nothing is to be seen on it."""
    low, high = (float(level) for level in cv2.minMaxLoc(cv2.blur(picture, (3, 3)))[:2])
    if high - low < MIN_CONTRAST:
        return None
    middle = (low + high) / 2.0
    border = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    if np.count_nonzero(border < middle) > border.size / 2:  # a dark ground
        picture, middle = 255 - picture, 255.0 - middle
    shade, inside = _lit(picture, picture < middle)
    if 1.0 - shade[inside].mean() < MIN_CONTRAST / 255.0:
        return None
    # What is a token's is known better once light is even.
    shade, inside = _lit(picture, shade < (1.0 + np.median(shade[inside])) / 2.0)
    covered: Singles = (1.0 - shade) / np.float32(1.0 - np.median(shade[inside]))
    return covered


def _lit(picture: Pixels, tokens: Bools) -> tuple[Singles, Bools]:
    """(P, P) levels over those of lit ground, and where surely tokens are (P, P)."""
    mask = tokens.astype(np.uint8)
    shade: Singles = picture.astype(np.float32) / _light(picture, cv2.dilate(mask, _CLEAR) == 0)
    inside = cv2.erode(mask, _CLEAR) > 0
    if np.count_nonzero(inside) >= _FEW:
        return shade, inside
    # So small that a blur reaches its middle: there it is darkest.
    smooth = cv2.blur(shade, (3, 3))
    return shade, tokens & (smooth <= smooth[tokens].min() + _DEEP)


def _light(picture: Pixels, ground: Bools) -> Singles | np.float32:
    """(P, P) levels of a lit ground: a plane through what is seen of it, or one number."""
    rows, columns = np.nonzero(ground[::_SPARSE, ::_SPARSE])
    levels = picture[::_SPARSE, ::_SPARSE][rows, columns].astype(np.float64)
    if levels.size < 16:
        return np.float32(picture.max())
    if levels.std() < _EVEN:
        return np.float32(levels.mean())
    x, y = columns * _SPARSE, rows * _SPARSE
    design: Floats = np.column_stack([np.ones(len(x)), x, y])
    plane = np.linalg.solve(design.T @ design, design.T @ levels)
    side = np.arange(len(picture), dtype=np.float32)
    lit: Singles = (plane[0] + plane[1] * side + plane[2] * side[:, None]).astype(np.float32)
    return np.maximum(lit, 1.0)
