"""Grayscale pictures: coordinates of pixels, drawing without an engine, and pixels of Eq. 14.

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
_FINER = 4  # factor along a side by which pictures for agents are taken finer, then averaged


def token_pixels(picture: Pixels) -> Bools:
    """(P, P) pixels of which tokens cover more than half: px = 1 in Eq. 14."""
    mask: Bools = np.less(picture, _MIDDLE)
    return mask


def coverage(picture: Pixels) -> Singles:
    """(P, P) share of each pixel that tokens cover."""
    covered: Singles = (np.float32(BACKGROUND) - picture) / np.float32(BACKGROUND - TOKEN_GRAY)
    return covered


def taken_pixels(sim: SimConfig) -> int:
    """The side in pixels of a picture before it is averaged."""
    return sim.pixels * (_FINER if sim.looks else 1)


def averaged(picture: Pixels, pixels: int) -> Pixels:
    """A picture reduced to `pixels` a side; each new pixel is the mean of a square block."""
    times = len(picture) // pixels
    if times == 1:
        return picture
    # Integer sums, first along rows, take a tenth of the time of numpy's mean over two axes.
    rows = picture.reshape(pixels, times, -1).sum(axis=1, dtype=np.uint32)
    whole = sum(rows[:, column::times] for column in range(times))
    mean: Pixels = np.round(whole / times**2).astype(np.uint8)
    return mean


def photograph(corners: Floats, layout: Layout, sim: SimConfig) -> Pixels:
    """The camera's picture (P, P) of tokens with corners (V, 2), drawn without an engine."""
    taken = rasterise(corners, layout, sim.arena * sim.view, taken_pixels(sim))
    return averaged(taken, sim.pixels)


def rasterise(corners: Floats, layout: Layout, arena: float, pixels: int) -> Pixels:
    """Picture (P, P) of tokens with corners (V, 2): dark where a token covers a pixel's centre."""
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
