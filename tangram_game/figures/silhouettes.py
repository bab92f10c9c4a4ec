"""A figure whose pieces are not told as what a run is to assemble: it is filled first.

What nothing fills is approached: the run lays the tokens as near to it as was found.

Legend: H x W pixels of a picture, N ways to fill it, V corners.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from tangram_core.arrays import Bools, Floats
from tangram_core.errors import ConfigError
from tangram_core.settings import refuse_ignored
from tangram_game.figures.puzzles import Figure, check_inside
from tangram_game.show.views import outlined
from tangram_sim.drawing.game_drawing import tiles
from tangram_sim.drawing.scenes import contact_sheet
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.targets import turned_figure
from tangram_tasks.place import Place

if TYPE_CHECKING:  # they need OpenCV and shapely
    from tangram_vision.solving import Answer

RED = (220, 38, 38)
_TILE = 480  # pixels of a picture that is alone
_EDGE = 3  # pixels: what differs less widely is the roughness of edges


@dataclass(frozen=True, eq=False)
class Shown:
    """A silhouette and what fills it, or comes nearest.

    Attributes:
        picture: of it, in colour.
        outlines: (N, V, 2) corners of the tokens, pixels of the picture, y down.
        figure: the tokens in the middle of a run's arena, as the first way has them.
        exact: whether they fill it.
        told: how it was filled, in words.
    """

    picture: Image.Image
    outlines: Floats
    figure: Figure
    exact: bool
    told: str


def answered(name: str, source: str, task: Place, count: int = 1) -> "Answer":
    """How a run's tokens make a figure.

    Args:
        name: of a file, or of a puzzle of the library.
        source: what errors call it.
        task: the run.
        count: of different ways to fill it, at most.

    Raises:
        ConfigError: it cannot be read, or OpenCV or shapely is not installed; or there is one way
            at most that can be shown.
    """
    try:
        # Only here: other targets need neither.
        from tangram_game.figures.methods import together  # noqa: PLC0415
        from tangram_vision import solving  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError(
            f"{source} needs OpenCV and shapely ({error}): install opencv-python-headless and "
            "shapely, or name a puzzle, as in puzzle=cat"
        ) from error
    layout, method = task.layout, together(task.layout)
    if task.outlines and count > 1:
        refuse_ignored(f"solutions={count}", "an agent of outlines", "name another run")
    seconds = solving.SECONDS
    return solving.answer(name, source, layout, task.tokens.scale, seconds, count, method)


def read_silhouette(name: str, task: Place, count: int = 1) -> Shown:
    """A silhouette, and a run's tokens in it; see `answered`.

    Raises:
        ConfigError: see there; or the tokens would reach out of the run's arena.
    """
    source, layout = f"silhouette={name}", task.layout
    answer = answered(name, source, task, count)
    first = answer.ways[0]
    poses = turned_figure(layout, (first.poses, first.flipped), 0.0)
    corners = layout.corners(poses, first.flipped)
    check_inside(
        source, task, corners, "draw it less long, or write out=solution.json, which needs no arena"
    )
    outlines = np.stack([answer.drawn.corners(layout, one) for one in answer.ways])
    picture = answer.drawn.picture
    if not answer.exact:
        picture = _reddened(picture, answer.drawn.mask, outlines[0], layout)
    figure = Figure(Path(name).stem, 0.0, poses, first.flipped)
    return Shown(picture, outlines, figure, answer.exact, answer.told)


# What is drawn


def draw_silhouette(silhouette: Shown, layout: Layout, width: int, bare: str = "") -> Image.Image:
    """The silhouette with the outlines of the tokens that fill it, in all ways that were found.

    Args:
        silhouette: what was found.
        layout: the tokens.
        width: of all ways together in pixels, about; one alone is as wide as a film.
        bare: what it is called without any tokens, as an agent of outlines is shown it.
    """
    if bare:
        nobody = np.zeros(layout.tokens, np.bool_)
        picture = outlined(silhouette.picture, layout, silhouette.outlines[0], _TILE, nobody)
        return contact_sheet([picture], 1, [bare])
    count = len(silhouette.outlines)
    columns, size = tiles(count, _TILE if count == 1 else width)
    pictures = [outlined(silhouette.picture, layout, one, size) for one in silhouette.outlines]
    captions = [f"{i + 1} of {count}" for i in range(count)]
    alone = silhouette.told if silhouette.exact else "the nearest figure; red: missing or over"
    return contact_sheet(pictures, columns, captions if count > 1 else [alone])


def _reddened(picture: Image.Image, mask: Bools, corners: Floats, layout: Layout) -> Image.Image:
    """The picture with red where the silhouette (H, W) and the tokens differ."""
    tokens = Image.new("1", picture.size)
    for k in range(layout.tokens):
        own = corners[layout.corners_of(k)]
        ImageDraw.Draw(tokens).polygon([(float(x), float(y)) for x, y in own], 1)
    differs = Image.fromarray(mask ^ np.asarray(tokens, np.bool_)).convert("L")
    wide = differs.filter(ImageFilter.MinFilter(_EDGE)).filter(ImageFilter.MaxFilter(_EDGE))
    red = picture.copy()
    red.paste(RED, None, wide)
    return red
