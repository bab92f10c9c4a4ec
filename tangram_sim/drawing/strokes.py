"""Drawing primitives of pictures for people: colours, outlines, fills and dashed lines.

A canvas is SAMPLES times as large as the final picture and is averaged at the end, so that edges
are smooth. Points are in pixels of the canvas, y down.
"""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from tangram_core.arrays import Floats
from tangram_sim.geometry.layout import Layout

PAPER = (250, 250, 247)
TABLE = (255, 255, 255)
FRAME = (214, 214, 208)
TARGET = (253, 236, 206)
TARGET_LINE = (146, 110, 40)
SILHOUETTE = (232, 226, 214)
TEXT = (55, 65, 81)
_TOKENS = (
    (59, 130, 196),
    (230, 126, 72),
    (76, 159, 112),
    (214, 90, 110),
    (138, 110, 190),
    (224, 176, 64),
    (72, 170, 178),
)
SAMPLES = 4
MARGIN = 0.04  # of the picture's side, around the arena

Point = tuple[float, float]
Colour = tuple[int, int, int]


def empty_table(side: int) -> Image.Image:
    """A square canvas of `side` pixels with the frame of the arena."""
    canvas = Image.new("RGB", (side, side), PAPER)
    edge = MARGIN * side
    frame = (edge, edge, side - edge, side - edge)
    ImageDraw.Draw(canvas).rectangle(frame, TABLE, FRAME, SAMPLES)
    return canvas


def shown(canvas: Image.Image) -> Image.Image:
    """The finished picture: the canvas averaged down to its final size."""
    return canvas.reduce(SAMPLES)


def to_points(arena: float, corners: Floats, side: int) -> list[Point]:
    """Points (M, 2) of the arena as points of a canvas with `side` pixels."""
    scale = side * (1.0 - 2.0 * MARGIN) / arena
    pixels = np.asarray(corners, dtype=np.float64) * (scale, -scale) + side / 2.0
    return [(float(x), float(y)) for x, y in pixels]


def to_outlines(layout: Layout, arena: float, corners: Floats, side: int) -> list[list[Point]]:
    """The outlines of tokens with corners (V, 2), on a canvas with `side` pixels."""
    points = to_points(arena, corners, side)
    return [points[layout.corners_of(k)] for k in range(layout.tokens)]


def fill(
    canvas: Image.Image,
    outline: Sequence[Point],
    colour: Colour,
    opacity: float,
    blur: float = 0.0,
) -> None:
    """Fill a polygon with a colour, its edge blurred by `blur` pixels; cut off at the canvas."""
    low = np.floor(np.min(outline, axis=0) - 3.0 * blur).astype(int)
    size = np.ceil(np.max(outline, axis=0) + 3.0 * blur).astype(int) - low + 1
    mask = Image.new("L", (int(size[0]), int(size[1])), 0)
    inside = [(x - float(low[0]), y - float(low[1])) for x, y in outline]
    ImageDraw.Draw(mask).polygon(inside, round(255 * opacity))
    if blur:
        mask = mask.filter(ImageFilter.GaussianBlur(blur))
    canvas.paste(colour, (int(low[0]), int(low[1])), mask)


def colour_of(token: int) -> Colour:
    """The colour of a token by its number."""
    return _TOKENS[token % len(_TOKENS)]


def darker(colour: Colour) -> Colour:
    """A darker shade of a colour, for an outline."""
    red, green, blue = (channel * 6 // 10 for channel in colour)
    return red, green, blue


def draw_outline(
    canvas: Image.Image, outline: Sequence[Point], colour: Colour, width: float
) -> None:
    """Draw a closed line; `width` is in widths of a token's outline."""
    closed = [*outline, outline[0], outline[1]]
    ImageDraw.Draw(canvas).line(closed, colour, round(width * 1.4 * SAMPLES), joint="curve")


def draw_dashes(
    canvas: Image.Image, points: Sequence[Point], colour: Colour, closed: bool = True
) -> None:
    """Draw a dashed line with a dash at every point; a closed one returns to the first point."""
    draw = ImageDraw.Draw(canvas)
    ahead = [*points[1:], points[0]] if closed else points[1:]
    for start, end in zip(points, ahead, strict=False):
        (x, y), (to_x, to_y) = start, end
        length = float(np.hypot(to_x - x, to_y - y))
        # An odd number of equal parts, every other one drawn: the first and the last are dashes.
        parts = 2 * max(round(length / (10.0 * SAMPLES)), 1) + 1
        for i in range(0, parts, 2):
            ends = [(x + (to_x - x) * j / parts, y + (to_y - y) * j / parts) for j in (i, i + 1)]
            draw.line(ends, colour, round(1.3 * SAMPLES))
