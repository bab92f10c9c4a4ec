"""A silhouette from a file or by name -> where a layout's tokens lie that fill it.

A file is a PNG or JPEG of it, dark on light or the reverse; an SVG of its outline, or of pieces
that make it up; or a puzzle, whose pieces are forgotten. Its scale, its place and its angle are
free: the area tells the scale.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from PIL import Image, ImageDraw
from shapely import Polygon

from tangram_sim.arrays import Floats
from tangram_sim.assembly import Puzzle, PuzzleRules
from tangram_sim.errors import ConfigError
from tangram_sim.geometry import outlines
from tangram_sim.layout import Layout
from tangram_sim.puzzles import load_puzzle, read_puzzles
from tangram_sim.sketches import read_text
from tangram_sim.svg import svg_outlines
from tangram_vision.dissections import Area, Dissection, grown
from tangram_vision.photos import find_silhouette
from tangram_vision.picture_files import read_picture
from tangram_vision.silhouettes import Filled, fill_outline, fill_picture

_DRAWN = 640  # pixels along the longer side of an outline that is drawn
_BORDER = 0.1  # of it, around the outline
_INK, _PAPER = (55, 60, 68), (250, 250, 247)
_SEAM = 0.004  # of the root of its area: gaps between drawn pieces that are closed
_POINTS = 2_000  # corners of an outline
PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, eq=False)
class Silhouette:
    """What a file showed, and how tokens fill it.

    Attributes:
        picture: of it, in colour.
        filled: how; poses are in the units of the layout, from the picture's upper left corner.
        unit: pixels of the picture in such a unit.
    """

    picture: Image.Image
    filled: Filled
    unit: float


def fill_silhouette(name: str, source: str, layout: Layout, seconds: float) -> Silhouette:
    """Read a silhouette and fill it.

    Args:
        name: of a file, or of a puzzle of the library.
        source: what errors call it.
        layout: the tokens.
        seconds: for the search.

    Raises:
        ConfigError: a file that cannot be used; whether it was filled is not checked.
    """
    path = Path(name)
    if path.suffix.lower() in PICTURES:
        return _from_picture(read_picture(path, source), source, layout, seconds)
    if path.suffix.lower() == ".svg":
        drawn = [Polygon(one) for one in svg_outlines(read_text(path), path.stem)]
        return _from_outline(_joined(drawn, source), layout, seconds)
    puzzle = _puzzle(path, source) if path.suffix.lower() == ".json" else load_puzzle(name, 1.0)
    pieces = outlines(puzzle.layout.corners(puzzle.poses)[None], puzzle.layout)[0]
    return _from_outline(_joined([Polygon(one) for one in pieces], source), layout, seconds)


def _puzzle(path: Path, source: str) -> Puzzle:
    found = read_puzzles(path, PuzzleRules(1.0, subset=True)).puzzles
    if len(found) != 1:
        raise ConfigError(
            f"{source} has {len(found)} puzzles, and one silhouette is filled: take a file of one"
        )
    return found[0]


def _joined(polygons: list[Polygon], source: str) -> Area:
    """One area of several outlines; one that lies in another is a hole in it, and so on."""
    if sum(len(one.exterior.coords) for one in polygons) > _POINTS:
        raise ConfigError(
            f"{source} has more than {_POINTS} corners: draw straight sides, or give a PNG of it"
        )
    valid = [shapely.make_valid(one) for one in polygons]
    inside = [sum(shapely.contains_properly(other, one) for other in valid) for one in valid]
    area: Area = Polygon()
    for depth in range(max(inside) + 1):
        own = shapely.union_all([one for one, d in zip(valid, inside, strict=True) if d == depth])
        area = shapely.difference(area, own) if depth % 2 else shapely.union(area, own)
    size = float(np.sqrt(area.area))
    if not size > 0.0:
        raise ConfigError(f"{source} draws nothing that has an area: draw an outline")
    return grown(grown(area, _SEAM * size), -_SEAM * size)


def _from_outline(area: Area, layout: Layout, seconds: float) -> Silhouette:
    """Scaled to the tokens' area, filled, and drawn."""
    low_x, low_y, high_x, high_y = area.bounds
    scale = float(np.sqrt(layout.areas.sum() / area.area))
    border = _BORDER * max(high_x - low_x, high_y - low_y)

    def placed(points: Floats) -> Floats:
        moved: Floats = (points - (low_x - border, high_y + border)) * scale
        return moved

    own = shapely.transform(area, placed)
    (filled,) = fill_outline(own, layout, seconds)
    width, height = high_x - low_x + 2.0 * border, high_y - low_y + 2.0 * border
    unit = _DRAWN / (max(width, height) * scale)
    size = (round(width * scale * unit), round(height * scale * unit))
    return Silhouette(_drawn(own, size, unit), filled, unit)


def _drawn(area: Area, size: tuple[int, int], unit: float) -> Image.Image:
    canvas = Image.new("RGB", size, _PAPER)
    brush = ImageDraw.Draw(canvas)
    for part in shapely.get_parts(area).tolist():
        for ring, ink in ((part.exterior, _INK), *((hole, _PAPER) for hole in part.interiors)):
            points = np.asarray(ring.coords) * (unit, -unit)
            brush.polygon([(float(x), float(y)) for x, y in points], ink)
    return canvas


def _from_picture(picture: Image.Image, source: str, layout: Layout, seconds: float) -> Silhouette:
    """The scale is that at which as many pixels are covered as the tokens are large."""
    shade = find_silhouette(picture, layout, source)
    share = float(shade.cover.sum()) / shade.cover.size
    view = float(np.sqrt(layout.areas.sum() / share))
    filled = fill_picture(shade.cover, layout, view, seconds)
    unit = shade.pixels / view
    if filled.found is not None:
        corner = np.array([shade.corner[0], -shade.corner[1], 0.0]) / (unit, unit, 1.0)
        moved = Dissection(filled.found.poses + corner, filled.found.flipped)
        filled = replace(filled, found=moved)
    return Silhouette(picture, filled, unit)
