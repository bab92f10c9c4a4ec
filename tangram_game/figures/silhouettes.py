"""A silhouette as what a run is to assemble: it is filled with the run's tokens first.

What cannot be filled is told, and drawn as far as it could be.

Legend: H x W pixels of a picture, N ways to fill it, V corners.
"""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from tangram_core.arrays import Bools, Floats
from tangram_core.errors import ConfigError, RunError
from tangram_core.run.outcome import plural
from tangram_core.settings import refuse_ignored
from tangram_core.store.files import write_whole
from tangram_game.figures.puzzles import Figure, check_inside
from tangram_game.show.views import outlined
from tangram_sim.drawing.game_drawing import tiles
from tangram_sim.drawing.scenes import contact_sheet
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.targets import has_all_tans, turned_figure
from tangram_tasks.place import Place

if TYPE_CHECKING:  # they need OpenCV and shapely
    from tangram_vision.given.silhouette_files import Silhouette

SECONDS = 5.0  # of the search
RED = (220, 38, 38)
_TILE = 480  # pixels of a picture that is alone
_EDGE = 3  # pixels: what differs less widely is the roughness of edges


@dataclass(frozen=True, eq=False)
class Shown:
    """A silhouette and what fills it.

    Attributes:
        picture: of it, in colour.
        outlines: (N, V, 2) corners of the tokens that fill it, pixels of the picture, y down.
        figure: the tokens in the middle of a run's arena, as the first way has them.
        told: how it was filled, in words.
    """

    picture: Image.Image
    outlines: Floats
    figure: Figure
    told: str


def read_silhouette(name: str, task: Place, count: int = 1, out: Path | None = None) -> Shown:
    """A silhouette, filled with a run's tokens.

    Args:
        name: of a file, or of a puzzle of the library.
        task: the run.
        count: of different ways to fill it, at most.
        out: a PNG file for the best attempt where nothing fills it; None is none.

    Raises:
        ConfigError: it cannot be read or filled, or OpenCV or shapely is not installed; or there is
            one way at most that is found or can be shown.
    """
    try:
        # Only here: other targets need neither.
        from tangram_game.figures.methods import together  # noqa: PLC0415
        from tangram_vision.given.silhouette_files import fill_silhouette  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError(
            f"silhouette needs OpenCV and shapely ({error}): install opencv-python-headless and "
            "shapely, or leave silhouette out"
        ) from error
    source, layout = f"silhouette={name}", task.layout
    if task.outlines and count > 1:
        refuse_ignored(f"solutions={count}", "an agent of outlines", "name another run")
    method = together(layout)
    drawn = fill_silhouette(name, source, layout, task.tokens.scale, SECONDS, count, method)
    laid = [one.found for one in drawn.filled if one.found is not None and one.solved]
    if not laid:
        beside = "" if out is None else f"; {_kept(_draw_attempt(drawn, layout), out)}"
        raise ConfigError(f"{source} {why_unfilled(drawn, layout)}{beside}")
    poses = turned_figure(layout, (laid[0].poses, laid[0].flipped), 0.0)
    corners = layout.corners(poses, laid[0].flipped)
    check_inside(source, task, corners, "name a run of a larger arena")
    outlines = np.stack([drawn.corners(layout, one) for one in laid])
    figure = Figure(Path(name).stem, 0.0, poses, laid[0].flipped)
    return Shown(drawn.picture, outlines, figure, _told(drawn, count))


def _told(drawn: "Silhouette", count: int) -> str:
    """How it was filled."""
    first, found = drawn.filled[0], len(drawn.filled)
    if count == 1:
        return f"filled by the {first.by} in {first.seconds:.2f} s, IoU {first.iou:.3f}"
    others = ", all that there are" if first.complete else ""
    more = "" if found == count or first.complete else f", no more in {SECONDS:g} s"
    return f"{plural(found, 'dissection')}{others}{more}"


def why_unfilled(drawn: "Silhouette", layout: Layout) -> str:
    """Why it was not filled, and what to do."""
    (filled,) = drawn.filled
    names = ", ".join(shape.name for shape in layout.shapes)
    tokens = "the seven tans" if has_all_tans(layout) else names
    if drawn.share is not None:
        share = f"{drawn.share:.2f}" if 0.01 <= drawn.share < 100.0 else f"{drawn.share:.2g}"
        return (
            f"covers {share} of {tokens}: mend the outline or its side, or name a run of its pieces"
        )
    best = f"best found: IoU {filled.iou:.2f}" if filled.iou else "no token could be laid"
    if filled.complete:
        return (
            f"cannot be filled with {tokens} (no dissection: all ways were tried, {filled.nodes} "
            "steps): draw sides that are straight, and corners where tokens have theirs"
        )
    return (
        f"was not filled with {tokens} in {filled.seconds:.1f} s ({best}): draw sides that are "
        "straight, or give a larger picture, or its outline as JSON"
    )


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
    return contact_sheet(pictures, columns, captions if count > 1 else [silhouette.told])


def _draw_attempt(drawn: "Silhouette", layout: Layout) -> Image.Image:
    """The tokens that could be laid, and in red what they miss and where they stand over."""
    (filled,) = drawn.filled
    laid = filled.found or filled.attempt
    count = 0 if laid is None else len(laid.laid)
    corners = np.zeros((len(layout.body), 2)) if laid is None else drawn.corners(layout, laid)
    lies = np.zeros(layout.tokens, np.bool_)
    if laid is not None:
        lies[laid.laid] = True
    picture = _reddened(drawn.picture, drawn.mask, corners, layout, lies)
    told = (
        f"{count} of {plural(layout.tokens, 'token')}, IoU {filled.iou:.2f}; red: missing or over"
    )
    return contact_sheet([outlined(picture, layout, corners, _TILE, lies)], 1, [told])


def _reddened(
    picture: Image.Image, mask: Bools, corners: Floats, layout: Layout, lies: Bools
) -> Image.Image:
    """The picture with red where the silhouette (H, W) and the tokens that lie differ."""
    tokens = Image.new("1", picture.size)
    for k in np.flatnonzero(lies).tolist():
        own = corners[layout.corners_of(k)]
        ImageDraw.Draw(tokens).polygon([(float(x), float(y)) for x, y in own], 1)
    differs = Image.fromarray(mask ^ np.asarray(tokens, np.bool_)).convert("L")
    wide = differs.filter(ImageFilter.MinFilter(_EDGE)).filter(ImageFilter.MaxFilter(_EDGE))
    red = picture.copy()
    red.paste(RED, None, wide)
    return red


def _kept(picture: Image.Image, out: Path) -> str:
    """Write an attempt, beside a film that there will not be, and say where."""
    path = out if out.suffix == ".png" else out.with_suffix(".attempt.png")
    data = BytesIO()
    picture.save(data, format="PNG")
    try:
        write_whole(path, data.getvalue())
    except RunError as error:
        return f"the best attempt is not drawn: {error}"
    return f"the best attempt is drawn in {path}"
