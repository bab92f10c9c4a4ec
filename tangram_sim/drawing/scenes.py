"""Pictures of scenes, drawn from corners without engine or camera.

Filled tokens lie over the pale target. Several pictures make a contact sheet, a GIF or a film.
"""

import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from tangram_core.arrays import Floats, Singles
from tangram_core.scores import decimal
from tangram_sim.drawing.strokes import (
    PAPER,
    SAMPLES,
    TARGET,
    TARGET_LINE,
    TEXT,
    Point,
    colour_of,
    darker,
    draw_dashes,
    draw_outline,
    empty_table,
    fill,
    shown,
    to_outlines,
)
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import covered_share

_OPACITY = 0.8  # of a token, so that the target shows through
_PALETTE_FRAMES = 40  # frames from which the colours of a GIF are chosen
_GHOST = 0.18  # opacity of a token where it started
SMALLEST_TEXT = 9  # pixels
START, WAY, END, GOAL = MARKS = ("start", "way", "end", "target")
MEANING = ("coverage: covered share", "of the target, 1 is all of it")


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
        corners: (V, 2) of the tokens; parts outside the picture are cut off.
        goal: (V, 2) of the targets.
        size: side in pixels.
        active: number of the token to mark by a thick outline, if any.
        start: (V, 2) first corners of the tokens, if any: drawn pale, with the way from there.
    """
    canvas = empty_table(size * SAMPLES)
    pieces = to_outlines(layout, arena, corners, canvas.width)
    targets = to_outlines(layout, arena, goal, canvas.width)
    for target in targets:
        fill(canvas, target, TARGET, 1.0)
    if start is not None:
        _draw_starts(canvas, to_outlines(layout, arena, start, canvas.width), pieces)
    for k, piece in enumerate(pieces):
        fill(canvas, piece, colour_of(k), _OPACITY)
    for k, piece in enumerate(pieces):
        draw_outline(canvas, piece, darker(colour_of(k)), 2.0 if k == active else 1.0)
    for target in targets:
        draw_dashes(canvas, target, TARGET_LINE)
    return shown(canvas)


def episode_sheet(
    layout: Layout,
    arena: float,
    starts: Floats | Singles,
    ends: Floats | Singles,
    goals: Floats | Singles,
    columns: int = 4,
    size: int = 240,
    shares: Floats | None = None,
) -> Image.Image:
    """A sheet with one picture for each of E episodes, captioned with its overlap, and a legend.

    `starts`, `ends` and `goals` are corners (E, V, 2) of tokens and targets; `size` is the side of
    one picture in pixels. `shares` (E,) replaces the overlap in episodes without all tokens.
    """
    starts, ends, goals = (np.asarray(part, np.float64) for part in (starts, ends, goals))
    scenes = [
        draw_scene(layout, arena, end, goal, size, start=start)
        for start, end, goal in zip(starts, ends, goals, strict=True)
    ]
    covered = covered_share(ends, goals, layout) if shares is None else shares
    captions = [f"coverage  {decimal(share)}" for share in covered]
    sheet = contact_sheet(scenes, columns, captions)
    return with_legend(sheet, max(size // 18, SMALLEST_TEXT))


def with_legend(sheet: Image.Image, text: int) -> Image.Image:
    """The sheet with a legend of its shapes and numbers below, in letters of `text` pixels.

    A long legend takes several lines. A sheet narrower than the longest entry is widened.
    """
    font, gap = ImageFont.load_default(text), text // 2
    indents = [text + gap] * len(MARKS) + [0] * len(MEANING)
    words = list(zip((*MARKS, *MEANING), indents, strict=True))
    lengths = [indent + math.ceil(font.getlength(told)) for told, indent in words]
    width = max(sheet.width, max(lengths) + 2 * gap)
    places, left, line = [], gap, 0
    for length, indent in zip(lengths, indents, strict=True):
        if left > gap and left + length > width - gap:
            left, line = gap, line + 1
        places.append((left, line))
        left += length + (2 * gap if indent else text // 4)
    step = text * 3 // 2
    whole = Image.new("RGB", (width, sheet.height + (line + 1) * step + gap), PAPER)
    whole.paste(sheet)
    draw = ImageDraw.Draw(whole)
    for (left, line), (told, indent) in zip(places, words, strict=True):
        middle = sheet.height + line * step + step // 2
        if indent:
            whole.paste(_mark(told, text), (left, middle - text // 2))
        draw.text((left + indent, middle), told, TEXT, font, anchor="lm")
    return whole


def _mark(name: str, side: int) -> Image.Image:
    """The mark of a legend entry: a small square, or a dashed line for the way."""
    canvas = Image.new("RGB", (side * SAMPLES, side * SAMPLES), PAPER)
    low, high, middle = 1.0 * SAMPLES, (side - 2.0) * SAMPLES, side * SAMPLES / 2.0
    square, colour = [(low, low), (high, low), (high, high), (low, high)], colour_of(0)
    if name == START:
        fill(canvas, square, colour, _GHOST)
    elif name == WAY:
        draw_dashes(canvas, [(low, middle), (high, middle)], colour, closed=False)
    elif name == END:
        fill(canvas, square, colour, _OPACITY)
        draw_outline(canvas, square, darker(colour), 1.0)
    else:
        fill(canvas, square, TARGET, 1.0)
        draw_dashes(canvas, square, TARGET_LINE)
    return shown(canvas)


def contact_sheet(
    images: Sequence[Image.Image], columns: int = 4, captions: Sequence[str] = ()
) -> Image.Image:
    """Pictures of equal size side by side, row after row, each with its caption below.

    Raises:
        ValueError: there are no pictures or columns, or captions do not match the pictures.
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
    sheet = Image.new("RGB", full, PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(max(width // 18, SMALLEST_TEXT))
    for i, image in enumerate(images):
        left = gap + (i % columns) * (width + gap)
        top = gap + (i // columns) * (height + text + gap)
        sheet.paste(image, (left, top))
        if captions:
            middle = (left + width / 2, top + height + text / 2)
            draw.text(middle, captions[i], TEXT, font, anchor="mm")
    return sheet


def save_gif(
    images: Sequence[Image.Image], target: Path | BinaryIO, milliseconds: int = 400
) -> None:
    """Write an endless animation of at least one picture, each shown for `milliseconds`."""
    if not images:
        raise ValueError("an animation needs at least one picture")
    # One palette for all frames, from frames all over the film, so that colours do not flicker.
    some = images[:: -(-len(images) // _PALETTE_FRAMES)]
    strip = contact_sheet(some, columns=len(some))
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


def save_mp4(images: Sequence[Image.Image], target: BinaryIO, milliseconds: int = 400) -> None:
    """Write a film in H.264, which all browsers play; ImportError if PyAV is missing."""
    if not images:
        raise ValueError("a film needs at least one picture")
    import av  # noqa: PLC0415 - optional

    with av.open(target, "w", format="mp4") as film:
        stream = film.add_stream("libx264", Fraction(1000, milliseconds), {"crf": "20"})
        # Players need colours at half the resolution (yuv420p), so sides must be even.
        stream.width, stream.height = (side + side % 2 for side in images[0].size)
        stream.pix_fmt = "yuv420p"
        for image in images:
            even = Image.new("RGB", (stream.width, stream.height), PAPER)
            even.paste(image)
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(even))))
        film.mux(stream.encode())


def _draw_starts(
    canvas: Image.Image, ghosts: Sequence[list[Point]], pieces: Sequence[list[Point]]
) -> None:
    """Draw each token pale where it started, and a dashed line from there to its place."""
    for k, ghost in enumerate(ghosts):
        fill(canvas, ghost, colour_of(k), _GHOST)
    for k, (ghost, piece) in enumerate(zip(ghosts, pieces, strict=True)):
        ends = [(float(x), float(y)) for x, y in (np.mean(ghost, axis=0), np.mean(piece, axis=0))]
        draw_dashes(canvas, ends, colour_of(k), closed=False)
