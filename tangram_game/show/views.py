"""Pictures that an agent saw, with the outlines of the tokens found in them.

Legend: E episodes, T steps, K tokens, V corners, P pixels along a side.
"""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from tangram_core.arrays import Bools, Floats
from tangram_core.run.outcome import plural
from tangram_sim.drawing.scenes import contact_sheet
from tangram_sim.drawing.strokes import FRAME, PAPER, SAMPLES, Point, colour_of, draw_outline, shown
from tangram_sim.geometry.layout import Layout
from tangram_tasks.place import Place
from tangram_tasks.played import Played


def outlined(
    picture: Image.Image, layout: Layout, outlines: Floats, size: int, found: Bools | None = None
) -> Image.Image:
    """A picture fitted into a square, with the outlines of tokens over it.

    Args:
        picture: of any size.
        layout: the tokens.
        outlines: (V, 2) corners of the tokens in pixels of the picture, y down.
        size: side of the square in pixels.
        found: (K,) tokens to draw; None: all.
    """
    share = size * SAMPLES / max(picture.size)
    width, height = (round(side * share) for side in picture.size)
    left, top = (size * SAMPLES - width) // 2, (size * SAMPLES - height) // 2
    canvas = Image.new("RGB", (size * SAMPLES, size * SAMPLES), PAPER)
    canvas.paste(picture.resize((width, height), Image.Resampling.BILINEAR), (left, top))
    edge = (left, top, left + width - 1, top + height - 1)
    ImageDraw.Draw(canvas).rectangle(edge, None, FRAME, SAMPLES)
    for k in range(layout.tokens):
        if found is None or found[k]:
            own = outlines[layout.corners_of(k)] * share + (left, top)
            points: list[Point] = [(float(x), float(y)) for x, y in own]
            draw_outline(canvas, points, PAPER, 3.0)
            draw_outline(canvas, points, colour_of(k), 2.0)
    return shown(canvas)


def camera_sheets(task: Place, played: Played, columns: int, size: int) -> list[Image.Image]:
    """Sheets of all episodes' pictures, one for each of T + 1 moments; empty if none were seen.

    Args:
        task: the task as it was played.
        played: the episodes.
        columns: pictures in a row.
        size: side of a picture in pixels.
    """
    pictures = played.pictures
    if pictures is None:
        return []
    seen = played.episodes["seen"]
    layout, side = task.layout, pictures.shape[-1]
    unit = side / task.sim.arena
    corners = played.episodes["corners"].astype(np.float64) * (unit, -unit) + side / 2.0
    sheets = []
    for t in range(pictures.shape[1]):
        found = seen[:, t] > 0
        scenes = [
            outlined(Image.fromarray(one).convert("RGB"), layout, *rest)
            for one, *rest in zip(
                pictures[:, t], corners[:, t], [size] * len(pictures), found, strict=True
            )
        ]
        sheets.append(contact_sheet(scenes, columns, [_told(own) for own in found]))
    return sheets


def beside(frames: Sequence[Image.Image], sheets: Sequence[Image.Image]) -> list[Image.Image]:
    """The sheet of the moment of each frame of a film.

    A film has one frame of the start, equally many of each action, and perhaps one of the end, see
    `tangram_game.show.film.film`.
    """
    actions = len(sheets) - 1
    each = (len(frames) - 1) // actions
    return [sheets[min(number // each, actions)] for number in range(len(frames))]


def _told(found: Bools) -> str:
    """The caption of a camera's picture."""
    count = int(np.count_nonzero(found))
    return "seen by the camera" if found.all() else f"{plural(count, 'token')} of {len(found)} seen"
