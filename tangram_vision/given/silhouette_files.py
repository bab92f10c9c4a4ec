"""A silhouette from a file or by name -> where a layout's tokens lie that fill it.

A file is a picture of it, dark on light or the reverse, or tells its outline. Its place and its
angle are free, and so is its scale: the area tells it, also where a file tells another.

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
from tangram_sim.geometry.areas import Area, valid
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.layout import Layout
from tangram_vision.given.outline_files import Drawn, read_outline
from tangram_vision.given.photos import Shade, find_silhouette
from tangram_vision.given.picture_files import Given, read_picture
from tangram_vision.silhouettes.silhouette_pictures import fill_picture
from tangram_vision.silhouettes.silhouettes import Filled, fill_outline
from tangram_vision.silhouettes.tilts import mapped, shift

_DRAWN = 640  # pixels along the longer side of an outline that is drawn
_BORDER = 0.1  # of it, around the outline
_INK, _PAPER = (55, 60, 68), (250, 250, 247)
_LINES = 4  # times as much as is drawn lies within lines; of tans around a hole less
_OFF = 0.05  # of the tokens' area, by which that of a drawing of known scale may be wrong


@dataclass(frozen=True, eq=False)
class Silhouette:
    """What a file showed, and how tokens fill it.

    Attributes:
        picture: of it, in colour.
        mask: (H, W) which of its pixels are the silhouette's.
        filled: how, or how it was tried; poses are in the units of the layout.
        drawing: homography (3, 3) of points in such units to columns and rows of the picture.
        area: of it, in such units.
        share: its area over that of the tokens where the file tells its scale, and they differ.
        page: width and height of the file's own page; of outlines it is the picture.
        own: homography (3, 3) of points of the picture to points of that page.
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
        """(V, 2) of the tokens, columns and rows of the picture."""
        return mapped(self.drawing, layout.corners(found.poses, found.flipped))


def fill_silhouette(
    name: str, source: str, layout: Layout, scale: float, seconds: float
) -> Silhouette:
    """Read a silhouette and fill it.

    Args:
        name: of a file, or of a puzzle of the library.
        source: what errors call it.
        layout: the tokens.
        scale: side of the full square that they are cut from, in their units.
        seconds: for the search.

    Raises:
        ConfigError: a file that cannot be used; whether it was filled is not checked.
    """
    path = Path(name)
    if path.suffix.lower() in ("", ".json"):
        return _from_outline(read_outline(name, source), layout, scale, seconds)
    return _from_picture(read_picture(path, source), source, layout, seconds)


def _from_outline(drawn: Drawn, layout: Layout, scale: float, seconds: float) -> Silhouette:
    """Scaled to the tokens' area, filled, and drawn."""
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
    """An area so many times as large in a picture, its width and height, and pixels of a unit."""
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
    # What lies in a hole is smaller than what has the hole, and is drawn after it.
    for part in sorted(shapely.get_parts(area).tolist(), key=lambda part: -part.area):
        for ring, ink in ((part.exterior, 1), *((hole, 0) for hole in part.interiors)):
            points = np.asarray(ring.coords) * (unit, -unit)
            brush.polygon([(float(x), float(y)) for x, y in points], ink)
    return np.asarray(canvas, np.bool_)


def _inked(mask: Bools) -> Image.Image:
    return Image.fromarray(np.where(mask[..., None], _INK, _PAPER).astype(np.uint8))


def _from_picture(given: Given, source: str, layout: Layout, seconds: float) -> Silhouette:
    """The scale is that at which as many pixels are covered as the tokens are large."""
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
    """What a figure that is drawn by lines alone encloses; any other as it is."""
    mask = (shade.cover > 0.5).astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole = cv2.drawContours(np.zeros_like(mask), contours, -1, 1, cv2.FILLED)
    if whole.sum() < _LINES * mask.sum():
        return shade
    # The outer edge keeps its levels.
    within = cv2.erode(whole, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))
    return replace(shade, cover=np.maximum(shade.cover, within.astype(np.float32)))


def _traced(cover: Singles, unit: float) -> Area:
    """What coverage (P, P) shows along its half level, a pixel being so large, y up."""
    levels = np.pad(cover, 1)  # so that every line is closed
    middles = np.arange(len(levels)) - 0.5
    lines = contourpy.contour_generator(middles, middles, levels).lines(0.5)
    rings = [valid(Polygon(line)) for line in lines if len(line) > 3]
    # A ring within another is a hole.
    area: Area = valid(reduce(shapely.symmetric_difference, rings, Polygon()))
    return shapely.transform(area, lambda points: points * (unit, -unit))


def _shaded(shade: Shade, size: tuple[int, int]) -> Bools:
    """(H, W) where a photograph of such a width and height shows the silhouette."""
    pixels = 1.0 / len(shade.cover)
    # OpenCV has the middle of a pixel at whole numbers.
    matrix = shift(-0.5, -0.5) @ shade.back @ np.diag([pixels, pixels, 1.0]) @ shift(0.5, 0.5)
    return np.asarray(cv2.warpPerspective(shade.cover, matrix, size)) > 0.5
