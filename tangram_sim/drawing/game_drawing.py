"""Pictures of the game: tokens over the silhouette of their target, one perhaps in motion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from tangram_core.arrays import Floats
from tangram_sim.drawing.scenes import contact_sheet
from tangram_sim.drawing.strokes import (
    SAMPLES,
    SILHOUETTE,
    colour_of,
    darker,
    draw_outline,
    empty_table,
    fill,
    shown,
    to_outlines,
    to_points,
)
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import covered_share

_EDGE = (168, 158, 138)
_OPACITY = 0.9
_INK = (31, 41, 55)
_RED = (200, 40, 40)
_NEARER = 0.12  # how much larger a lifted piece is drawn
_FINGER = 0.04  # its radius
_SHADOW = 0.35  # its opacity
_SHADOW_WAY = (0.03, -0.05)  # of the arena, to the right and down
_SHADOW_BLUR = 0.012  # of the picture's side
_SHEET = 1200  # pixels across, about
_MIN_TILE, _MAX_TILE = 120, 480


@dataclass(frozen=True, eq=False)
class Held:
    """The token that is being moved.

    Attributes:
        token: its number.
        height: from 0 (on the table) to 1 (in the air): drawn larger, with a shadow.
        stopped: whether it cannot be set down: drawn with a red outline.
        finger: (2,) centre of the finger that pushes it; None: no finger.
    """

    token: int
    height: float = 0.0
    stopped: bool = False
    finger: Floats | None = None


def draw_game(
    layout: Layout,
    arena: float,
    corners: Floats,
    goal: Floats,
    size: int = 320,
    held: Held | None = None,
) -> Image.Image:
    """One square picture of the pieces over the silhouette of their target, `size` pixels wide.

    Args:
        layout: which corners belong to which token.
        arena: width of the arena, the same unit as the corners.
        corners: (V, 2) of the tokens; parts outside the picture are cut off.
        goal: (V, 2) of the target.
        size: side in pixels.
        held: the piece in motion, drawn above the others.
    """
    canvas = empty_table(size * SAMPLES)
    # The target appears as one figure: the fill hides the inner half of every piece's edge.
    targets = to_outlines(layout, arena, goal, canvas.width)
    for target in targets:
        draw_outline(canvas, target, _EDGE, 2.0)
    for target in targets:
        fill(canvas, target, SILHOUETTE, 1.0)
    for k, piece in enumerate(to_outlines(layout, arena, corners, canvas.width)):
        if held is None or k != held.token:
            fill(canvas, piece, colour_of(k), _OPACITY)
            draw_outline(canvas, piece, darker(colour_of(k)), 1.0)
    if held is not None:
        own = np.asarray(corners[layout.corners_of(held.token)], dtype=np.float64)
        _draw_held(canvas, arena, held, own)
    return shown(canvas)


def figure_sheet(
    layout: Layout, arena: float, ends: Floats, goals: Floats, titles: Sequence[str]
) -> Image.Image:
    """A sheet with one picture for each of E figures, captioned with title and coverage.

    `ends` and `goals` are corners (E, V, 2) of tokens and targets.
    """
    columns, size = tiles(len(ends), _SHEET)
    pictures = [
        draw_game(layout, arena, end, goal, size) for end, goal in zip(ends, goals, strict=True)
    ]
    return contact_sheet(pictures, columns, captions(layout, ends, goals, titles))


def captions(layout: Layout, ends: Floats, goals: Floats, titles: Sequence[str]) -> list[str]:
    """The title and the coverage (per cent) of each figure, as a text."""
    covered = covered_share(ends, goals, layout)
    return [f"{title}   {100 * share:.1f} %" for title, share in zip(titles, covered, strict=True)]


def tiles(count: int, width: int) -> tuple[int, int]:
    """The number of pictures in a row, and the side of each, for a sheet of `width` pixels."""
    columns = min(math.ceil(math.sqrt(1.4 * count)), count)
    return columns, min(max(width // columns, _MIN_TILE), _MAX_TILE)


def _draw_held(canvas: Image.Image, arena: float, held: Held, corners: Floats) -> None:
    middle = corners.mean(axis=0)
    nearer = middle + (corners - middle) * (1.0 + _NEARER * held.height)
    if held.height > 0.0:
        way = np.array(_SHADOW_WAY) * arena * held.height
        shadow, blur = to_points(arena, nearer + way, canvas.width), _SHADOW_BLUR * held.height
        fill(canvas, shadow, _INK, _SHADOW, blur * canvas.width)
    piece = to_points(arena, nearer, canvas.width)
    fill(canvas, piece, colour_of(held.token), 1.0)
    draw_outline(canvas, piece, _RED if held.stopped else _INK, 2.0)
    if held.finger is not None:
        ends = held.finger + np.array([[-_FINGER, _FINGER], [_FINGER, -_FINGER]])
        ImageDraw.Draw(canvas).ellipse(to_points(arena, ends, canvas.width), _INK)
