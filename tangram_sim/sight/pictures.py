"""The convention of grayscale pictures, and Eq. 14's pixels.

Pixel (row, column) of a picture of P x P pixels shows the point x = (column + 1/2) * arena / P -
arena / 2, y = arena / 2 - (row + 1/2) * arena / P: rows run down, as in every image file.
"""

import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels, Singles
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout

BACKGROUND = 255
TOKEN_GRAY = 80
_MIDDLE = (BACKGROUND + TOKEN_GRAY) // 2
_FINER = 4  # what agents see is averaged from so many times the pixels along a side


def token_pixels(picture: Pixels) -> Bools:
    """(P, P), where a picture shows a token, by more than half: px = 1 of Eq. 14."""
    mask: Bools = np.less(picture, _MIDDLE)
    return mask


def coverage(picture: Pixels) -> Singles:
    """(P, P), the share of each pixel that a picture shows covered by tokens."""
    covered: Singles = (np.float32(BACKGROUND) - picture) / np.float32(BACKGROUND - TOKEN_GRAY)
    return covered


def taken_pixels(sim: SimConfig) -> int:
    """The side of the picture that is taken before it is averaged."""
    return sim.pixels * (_FINER if sim.looks else 1)


def averaged(picture: Pixels, pixels: int) -> Pixels:
    """A picture with so many pixels along its side, each the mean of those that it stands for."""
    times = len(picture) // pixels
    if times == 1:
        return picture
    # Sums of whole numbers, row by row: a tenth of the time of numpy's mean over two axes.
    rows = picture.reshape(pixels, times, -1).sum(axis=1, dtype=np.uint32)
    whole = sum(rows[:, column::times] for column in range(times))
    mean: Pixels = np.round(whole / times**2).astype(np.uint8)
    return mean


def photograph(corners: Floats, layout: Layout, sim: SimConfig) -> Pixels:
    """What the camera shows, (P, P), of tokens with corners (V, 2), without an engine."""
    taken = rasterise(corners, layout, sim.arena * sim.view, taken_pixels(sim))
    return averaged(taken, sim.pixels)


def rasterise(corners: Floats, layout: Layout, arena: float, pixels: int) -> Pixels:
    """Picture (P, P) of tokens with corners (V, 2): a pixel is a token's if its centre is."""
    centres = (np.arange(pixels) + 0.5) * (arena / pixels) - arena / 2.0
    x, y = centres[None, :], -centres[:, None]
    picture = np.full((pixels, pixels), BACKGROUND, dtype=np.uint8)
    flipped = layout.flipped(corners)
    for token in range(layout.tokens):
        outline = corners[layout.corners_of(token)]
        if flipped[token]:
            outline = outline[::-1]
        inside = np.ones((pixels, pixels), dtype=np.bool_)
        for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            edge = end - start
            inside &= edge[0] * (y - start[1]) - edge[1] * (x - start[0]) >= 0.0
        picture[inside] = TOKEN_GRAY
    return picture
