"""Read a silhouette from a file, or by name, and fill it with a layout's tokens.

A file holds a picture, dark on light or the reverse, or an outline. Place, angle and scale of the
silhouette are free: its area is scaled to that of the tokens, even if a file gives another scale.

Legend: H x W pixels of a picture.
"""

from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import contourpy
import cv2
import numpy as np
import shapely
from PIL import Image, ImageDraw
from shapely import Polygon

from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.errors import ConfigError
from tangram_sim.drawing.strokes import PAPER
from tangram_sim.geometry.areas import Area, valid
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.layout import Layout
from tangram_vision.given.outline_files import Drawn, read_outline
from tangram_vision.given.photos import Shade, find_silhouette
from tangram_vision.given.picture_files import Given, read_picture
from tangram_vision.silhouettes.silhouette_pictures import fill_picture
from tangram_vision.silhouettes.silhouettes import Filled, fill_outline
from tangram_vision.silhouettes.tilts import mapped, shift

_DRAWN = 640  # pixels along the longer side of an outline's picture
_BORDER = 0.1  # of the outline's longer side, around the outline
_INK = 55, 60, 68
_LINES = 4  # a line drawing encloses this many times its own area; tans around a hole, less
_OFF = 0.05  # of the tokens' area: error of the area of a drawing of known scale, at most


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A silhouette from a file, and how tokens fill it.

    Attributes:
        picture: the silhouette in colour.
        mask: (H, W) which pixels of the picture belong to the silhouette.
        filled: the filling, or the attempt; poses are in the units of the layout.
        drawing: homography (3, 3) from points in these units to columns and rows of the picture.
        area: the silhouette, in these units.
        share: area of the file's silhouette over that of the tokens; None if the file gives no
            scale, or if both areas agree.
        page: width and height of the file's own page; for outlines, those of the picture.
        own: homography (3, 3) from points of the picture to points of that page.
    """

    picture: Image.Image
    mask: Bools
    filled: Filled
    drawing: Floats
    area: Area
    share: float | None
    page: tuple[float, float]
    own: Floats

    def corners(self, layout: Layout, found: Dissection) -> Floats:
        """(V, 2) corners of the tokens, in columns and rows of the picture."""
        return mapped(self.drawing, layout.corners(found.poses, found.flipped))


def fill_silhouette(
    name: str, source: str, layout: Layout, scale: float, seconds: float
) -> Silhouette:
    """Read a silhouette and fill it.

    Args:
        name: path of a file, or name of a puzzle of the library.
        source: name of the file in errors.
        layout: the tokens.
        scale: side of the full square that the tokens are cut from, in units of the layout.
        seconds: processor time for the search.

    Raises:
        ConfigError: the file cannot be used. A silhouette that was not filled is no error.
    """
    path = Path(name)
    if path.suffix.lower() in ("", ".json"):
        return _from_outline(read_outline(name, source), layout, scale, seconds)
    return _from_picture(read_picture(path, source), source, layout, seconds)


def _from_outline(drawn: Drawn, layout: Layout, scale: float, seconds: float) -> Silhouette:
    """Scale an outline to the tokens' area, fill it, and draw its picture."""
    area, total = drawn.area, float(layout.areas.sum())
    own = float(np.sqrt(total / area.area))
    share = None if drawn.side is None else float(area.area * (scale / drawn.side) ** 2 / total)
    wrong = share is not None and abs(share - 1.0) > _OFF
    placed, size, unit = _framed(area, own)
    filled = fill_outline(placed, layout, seconds)
    mask = _mask(placed, size, unit)
    drawing = np.diag([unit, -unit, 1.0])
    told = share if wrong else None
    return Silhouette(_inked(mask), mask, filled, drawing, placed, told, size, np.eye(3))


def _framed(area: Area, scale: float) -> tuple[Area, tuple[int, int], float]:
    """The area scaled and moved into a picture; the picture's size, and pixels in a unit."""
    low_x, low_y, high_x, high_y = area.bounds
    border = _BORDER * max(high_x - low_x, high_y - low_y)
    width, height = high_x - low_x + 2.0 * border, high_y - low_y + 2.0 * border
    pixels = _DRAWN / max(width, height)

    def placed(points: Floats) -> Floats:
        moved_there: Floats = (points - (low_x - border, high_y + border)) * scale
        return moved_there

    size = (round(width * pixels), round(height * pixels))
    return shapely.transform(area, placed), size, pixels / scale


def _mask(area: Area, size: tuple[int, int], unit: float) -> Bools:
    canvas = Image.new("1", size)
    brush = ImageDraw.Draw(canvas)
    # A part in a hole is smaller than the part with the hole, and must be drawn after it.
    for part in sorted(shapely.get_parts(area).tolist(), key=lambda part: -part.area):
        for ring, ink in ((part.exterior, 1), *((hole, 0) for hole in part.interiors)):
            points = np.asarray(ring.coords) * (unit, -unit)
            brush.polygon([(float(x), float(y)) for x, y in points], ink)
    return np.asarray(canvas, np.bool_)


def _inked(mask: Bools) -> Image.Image:
    return Image.fromarray(np.where(mask[..., None], _INK, PAPER).astype(np.uint8))


def _from_picture(given: Given, source: str, layout: Layout, seconds: float) -> Silhouette:
    """Fill the silhouette in a picture, at the scale that gives it the tokens' area."""
    shade = _closed(find_silhouette(given.picture, layout, source))
    if not (shade.cover > 0.5).any():
        raise ConfigError(
            f"{source} shows lines that are too thin to have an area: fill the figure with one tone"
        )
    share = float(shade.cover.sum()) / shade.cover.size
    view = float(np.sqrt(layout.areas.sum() / share))
    filled = fill_picture(shade.cover, layout, view, seconds)
    drawing = shade.back @ np.diag([1.0 / view, -1.0 / view, 1.0])
    area = _traced(shade.cover, view / len(shade.cover))
    mask = _shaded(shade, given.picture.size)
    return Silhouette(given.picture, mask, filled, drawing, area, None, given.size, given.own)


def _closed(shade: Shade) -> Shade:
    """The filled figure, if lines alone draw it; any other figure unchanged."""
    mask = (shade.cover > 0.5).astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole = cv2.drawContours(np.zeros_like(mask), contours, -1, 1, cv2.FILLED)
    if whole.sum() < _LINES * mask.sum():
        return shade
    # The outer edge keeps its levels.
    within = cv2.erode(whole, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))
    return replace(shade, cover=np.maximum(shade.cover, within.astype(np.float32)))


def _traced(cover: Singles, unit: float) -> Area:
    """The area where coverage (P, P) is above 0.5; `unit` is a pixel's width, y up."""
    levels = np.pad(cover, 1)  # so that every line is closed
    middles = np.arange(len(levels)) - 0.5
    lines = contourpy.contour_generator(middles, middles, levels).lines(0.5)
    rings = [valid(Polygon(line)) for line in lines if len(line) > 3]
    # A ring within another is a hole.
    area: Area = valid(reduce(shapely.symmetric_difference, rings, Polygon()))
    return shapely.transform(area, lambda points: points * (unit, -unit))


def _shaded(shade: Shade, size: tuple[int, int]) -> Bools:
    """(H, W) whether a pixel of the photograph, of `size` W x H, shows the silhouette."""
    pixels = 1.0 / len(shade.cover)
    # In OpenCV the centres of pixels are whole numbers.
    matrix = shift(-0.5, -0.5) @ shade.back @ np.diag([pixels, pixels, 1.0]) @ shift(0.5, 0.5)
    return np.asarray(cv2.warpPerspective(shade.cover, matrix, size)) > 0.5
