"""A figure with hidden pieces as a target: a search fills it before the run plays.

If the search finds no exact filling, the run assembles the nearest figure found.

Legend: H x W pixels of a picture, V corners.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from tangram_core.arrays import Bools, Floats
from tangram_core.errors import ConfigError
from tangram_game.figures.puzzles import Figure, check_inside
from tangram_game.show.views import outlined
from tangram_sim.drawing.scenes import contact_sheet
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.targets import turned_figure
from tangram_tasks.place import Place

if TYPE_CHECKING:  # they need OpenCV and shapely
    from tangram_vision.solving import Answer

RED = (220, 38, 38)
_TILE = 480  # side of a single picture in pixels
_EDGE = 3  # pixels: narrower differences are rough edges


@dataclass(frozen=True, eq=False)
class Shown:
    """A silhouette, and tokens that fill it or come nearest.

    Attributes:
        picture: the silhouette in colour.
        outlines: (V, 2) corners of the tokens in pixels of the picture, y down.
        figure: the tokens, moved to the middle of the run's arena.
        exact: whether the tokens fill the silhouette.
        told: how the silhouette was filled, in words.
    """

    picture: Image.Image
    outlines: Floats
    figure: Figure
    exact: bool
    told: str


def answered(name: str, source: str, task: Place) -> "Answer":
    """Search how a run's tokens fill a figure.

    Args:
        name: path of a file, or name of a puzzle of the library.
        source: name of the figure in errors.
        task: the task of the run.

    Raises:
        ConfigError: the figure cannot be read, or OpenCV or shapely is not installed.
    """
    try:
        # Imported here: other targets need neither OpenCV nor shapely.
        from tangram_vision import solving  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError(
            f"{source} needs OpenCV and shapely ({error}): install opencv-python-headless and "
            "shapely, or name a puzzle, as in puzzle=cat"
        ) from error
    return solving.answer(name, source, task.layout, task.tokens.scale, solving.SECONDS)


def read_silhouette(name: str, source: str, task: Place) -> Shown:
    """Read a silhouette and fill it with a run's tokens; see `answered`.

    Raises:
        ConfigError: as in `answered`, or the tokens would reach out of the run's arena.
    """
    layout = task.layout
    answer = answered(name, source, task)
    lies = answer.lies
    poses = turned_figure(layout, (lies.poses, lies.flipped), 0.0)
    corners = layout.corners(poses, lies.flipped)
    check_inside(
        source, task, corners, "draw it less long, or write out=solution.json, which needs no arena"
    )
    outlines = answer.drawn.corners(layout, lies)
    picture = answer.drawn.picture
    if not answer.exact:
        picture = _reddened(picture, answer.drawn.mask, outlines, layout)
    figure = Figure(Path(name).stem, 0.0, poses, lies.flipped)
    return Shown(picture, outlines, figure, answer.exact, answer.told)


# Drawing


def draw_silhouette(silhouette: Shown, layout: Layout, bare: str = "") -> Image.Image:
    """The silhouette with the outlines of the tokens in it.

    Args:
        silhouette: what was found.
        layout: the tokens.
        bare: title of a picture without tokens, as agents of outlines see it; empty: draw tokens.
    """
    shown = np.full(layout.tokens, not bare)
    picture = outlined(silhouette.picture, layout, silhouette.outlines, _TILE, shown)
    told = silhouette.told if silhouette.exact else "the nearest figure; red: missing or too much"
    return contact_sheet([picture], 1, [bare or told])


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
