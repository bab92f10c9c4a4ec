"""From levels of gray to coverage: which share of each pixel tokens cover.

Legend of this package: P pixels along a side of a picture, K tokens, N blobs. Coverage is (P, P)
float32, about 0 where a picture shows the ground and about 1 where it shows a token. Light may fall
off evenly across the picture; tokens may be darker than the ground or lighter.
"""

import cv2
import numpy as np

from tangram_sim.arrays import Bools, Floats, Pixels, Singles

MIN_CONTRAST = 40  # levels between ground and tokens; less is taken for noise
_EVEN = 1.0  # levels of deviation up to which the ground is taken to be lit evenly
_SPARSE = 3  # every so many rows and columns tell the light
_CLEAR = cv2.getStructuringElement(cv2.MORPH_RECT, (7, 7))


def coverage(picture: Pixels) -> Singles | None:
    """(P, P) of a picture (P, P); None if nothing is to be seen on it."""
    low, high = (float(level) for level in cv2.minMaxLoc(picture)[:2])
    if high - low < MIN_CONTRAST:
        return None
    _, dark_or_not = cv2.threshold(picture, 0, 255, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
    mask = np.asarray(dark_or_not, np.uint8)
    mean = float(cv2.mean(picture, mask)[0])
    if cv2.mean(picture, cv2.bitwise_not(mask))[0] - mean < MIN_CONTRAST:
        return None
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    if np.count_nonzero(border) > border.size / 2:  # a dark ground
        picture, mask = 255 - picture, 255 - mask
    ground = cv2.dilate(mask, _CLEAR) == 0
    light = _light(picture, ground)
    shade = picture.astype(np.float32) / light
    inside = cv2.erode(mask, _CLEAR) > 0
    dark = float(np.median(shade[inside if inside.any() else mask > 0]))
    covered: Singles = (1.0 - shade) / np.float32(1.0 - dark)
    return covered


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
    return lit
