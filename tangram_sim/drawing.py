"""Pictures of scenes from corners only: no engine, no camera.

Tokens are drawn filled over the pale target; whole episodes come as contact sheets or GIFs.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from tangram_sim.arrays import Floats, Singles
from tangram_sim.geometry import overlap_share
from tangram_sim.layout import Layout

_PAPER = (250, 250, 247)
_TABLE = (255, 255, 255)
_FRAME = (214, 214, 208)
_TARGET = (253, 236, 206)
_TARGET_LINE = (146, 110, 40)
_TEXT = (55, 65, 81)
_TOKENS = (
    (59, 130, 196),
    (230, 126, 72),
    (76, 159, 112),
    (214, 90, 110),
    (138, 110, 190),
    (224, 176, 64),
    (72, 170, 178),
)
_SAMPLES = 4  # drawn this many times as large, then averaged: smooth edges
_MARGIN = 0.04  # of the picture's side, around the arena
_OPACITY = 0.8  # of a token, so that the target shows through
_GHOST = 0.18  # opacity of a token where it started

_Point = tuple[float, float]
_Colour = tuple[int, int, int]


def draw_scene(
    layout: Layout,
    arena: float,
    corners: Floats,
    goal: Floats,
    size: int = 240,
    active: int | None = None,
    start: Floats | None = None,
) -> Image.Image:
    """One square picture of the tokens over their target.

    Args:
        layout: which corners belong to which token.
        arena: width of the arena, the same unit as the corners.
        corners: (V, 2) of the tokens; what lies outside the arena is cut at the picture's edge.
        goal: (V, 2) of the targets.
        size: side in pixels.
        active: the token to mark by a dark outline, if any.
        start: (V, 2) of the tokens at first: a pale ghost and the way from there, if given.
    """
    side = size * _SAMPLES
    canvas = Image.new("RGB", (side, side), _PAPER)
    draw = ImageDraw.Draw(canvas)
    edge = _MARGIN * side
    draw.rectangle((edge, edge, side - edge, side - edge), _TABLE, _FRAME, _SAMPLES)
    pieces = _to_pixels(layout, arena, corners, side)
    targets = _to_pixels(layout, arena, goal, side)
    for target in targets:
        draw.polygon(target, _TARGET)
    if start is not None:
        ghosts = _to_pixels(layout, arena, start, side)
        canvas = _with_tokens(canvas, ghosts, _GHOST)
        _draw_ways(ImageDraw.Draw(canvas), ghosts, pieces)
    canvas = _with_tokens(canvas, pieces, _OPACITY)
    draw = ImageDraw.Draw(canvas)
    for k, piece in enumerate(pieces):
        _outline(draw, piece, _darker(_colour(k)), 2.0 if k == active else 1.0)
    for target in targets:
        _dashes(draw, target, _TARGET_LINE)
    return canvas.resize((size, size), Image.Resampling.LANCZOS)


def episode_sheet(
    layout: Layout,
    arena: float,
    starts: Floats | Singles,
    ends: Floats | Singles,
    goals: Floats | Singles,
    columns: int = 4,
    size: int = 240,
) -> Image.Image:
    """One picture for each of E episodes: start, way, end and target, and the overlap below.

    Args:
        layout: which corners belong to which token.
        arena: width of the arena.
        starts, ends, goals: (E, V, 2) corners of tokens and targets.
        columns: pictures in a row.
        size: side of one picture in pixels.
    """
    starts, ends, goals = (np.asarray(part, np.float64) for part in (starts, ends, goals))
    scenes = [
        draw_scene(layout, arena, end, goal, size, start=start)
        for start, end, goal in zip(starts, ends, goals, strict=True)
    ]
    captions = [f"overlap  {share:.3f}" for share in overlap_share(ends, goals, layout)]
    return contact_sheet(scenes, columns, captions)


def contact_sheet(
    images: Sequence[Image.Image], columns: int = 4, captions: Sequence[str] = ()
) -> Image.Image:
    """Pictures of equal size side by side, row after row, each with its caption below.

    Raises:
        ValueError: no pictures, or captions that are not one per picture.
    """
    if not images or columns < 1:
        raise ValueError("a contact sheet needs at least one picture and one column")
    if captions and len(captions) != len(images):
        raise ValueError(f"got {len(captions)} captions for {len(images)} pictures")
    width, height = images[0].size
    gap = max(width // 30, 4)
    text = width // 8 if captions else 0
    rows = -(-len(images) // columns)
    columns = min(columns, len(images))
    full = (gap + columns * (width + gap), gap + rows * (height + text + gap))
    sheet = Image.new("RGB", full, _PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(max(width // 18, 9))
    for i, image in enumerate(images):
        left = gap + (i % columns) * (width + gap)
        top = gap + (i // columns) * (height + text + gap)
        sheet.paste(image, (left, top))
        if captions:
            middle = (left + width / 2, top + height + text / 2)
            draw.text(middle, captions[i], _TEXT, font, anchor="mm")
    return sheet


def save_gif(
    images: Sequence[Image.Image], target: Path | BinaryIO, milliseconds: int = 400
) -> None:
    """An endless animation, every picture shown for `milliseconds`.

    Raises:
        ValueError: no pictures.
    """
    if not images:
        raise ValueError("an animation needs at least one picture")
    # One palette for all frames, from all frames: colours must not flicker.
    strip = contact_sheet(images, columns=len(images))
    palette = strip.quantize(128, dither=Image.Dither.NONE)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    frames[0].save(
        target,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=milliseconds,
        loop=0,
        disposal=1,
    )


def _to_pixels(layout: Layout, arena: float, corners: Floats, side: int) -> list[list[_Point]]:
    """The outline of each token in pixels: x to the right, y down."""
    scale = side * (1.0 - 2.0 * _MARGIN) / arena
    pixels = np.asarray(corners, dtype=np.float64) * (scale, -scale) + side / 2.0
    return [
        [(float(x), float(y)) for x, y in pixels[layout.corners_of(k)]]
        for k in range(layout.tokens)
    ]


def _with_tokens(
    canvas: Image.Image, pieces: Sequence[list[_Point]], opacity: float
) -> Image.Image:
    for k, piece in enumerate(pieces):
        mask = Image.new("L", canvas.size, 0)
        ImageDraw.Draw(mask).polygon(piece, round(255 * opacity))
        canvas.paste(_colour(k), (0, 0), mask)
    return canvas


def _colour(token: int) -> _Colour:
    return _TOKENS[token % len(_TOKENS)]


def _darker(colour: _Colour) -> _Colour:
    red, green, blue = (channel * 6 // 10 for channel in colour)
    return red, green, blue


def _draw_ways(
    draw: ImageDraw.ImageDraw, ghosts: Sequence[list[_Point]], pieces: Sequence[list[_Point]]
) -> None:
    """A dashed line from each token's start to where it is."""
    for k, (ghost, piece) in enumerate(zip(ghosts, pieces, strict=True)):
        ends = [(float(x), float(y)) for x, y in (np.mean(ghost, axis=0), np.mean(piece, axis=0))]
        _dashes(draw, ends, _colour(k), closed=False)


def _outline(
    draw: ImageDraw.ImageDraw, piece: Sequence[_Point], colour: _Colour, width: float
) -> None:
    closed = [*piece, piece[0], piece[1]]
    draw.line(closed, colour, round(width * 1.4 * _SAMPLES), joint="curve")


def _dashes(
    draw: ImageDraw.ImageDraw, points: Sequence[_Point], colour: _Colour, closed: bool = True
) -> None:
    """A dashed line whose points are always drawn; a closed one ends where it began."""
    ahead = [*points[1:], points[0]] if closed else points[1:]
    for start, end in zip(points, ahead, strict=False):
        (x, y), (to_x, to_y) = start, end
        length = float(np.hypot(to_x - x, to_y - y))
        # An odd number of equal parts, drawn and left out in turn: ends and begins with a dash.
        parts = 2 * max(round(length / (10.0 * _SAMPLES)), 1) + 1
        for i in range(0, parts, 2):
            ends = [(x + (to_x - x) * j / parts, y + (to_y - y) * j / parts) for j in (i, i + 1)]
            draw.line(ends, colour, round(1.3 * _SAMPLES))
