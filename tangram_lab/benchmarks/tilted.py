"""Silhouettes photographed aslant: how many are filled, as they are and after being straightened.

A camera looks at the middle of the figure from a distance of so many of its widths, tilted by some
degrees towards any side. Its picture is made here, point by point, of ink on paper.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import shapely
from PIL import Image, ImageDraw

from tangram_sim.areas import Area
from tangram_sim.arrays import Floats
from tangram_sim.layout import Layout
from tangram_vision.photos import find_silhouette
from tangram_vision.silhouette_pictures import fill_picture
from tangram_vision.silhouettes import SOLVED

TILTS = (0.0, 5.0, 10.0, 15.0)  # degrees
PIXELS = 512
_WIDTH = 0.6  # of the picture that a figure takes
_DISTANCE = 1.6  # widths of the figure, from which a telephone's camera shows it so large
_FINE = 4  # points along a pixel
_INK, _PAPER = 50, 225
SECONDS = 10.0  # of processor time


def tilted_rows(layout: Layout, areas: Sequence[Area], seed: int) -> Iterator[dict[str, Any]]:
    """A row for each tilt: shares of the figures that are filled."""
    for tilt in TILTS:
        generator = np.random.default_rng(seed)
        pictures = [photographed(area, tilt, generator.uniform(0.0, 360.0)) for area in areas]
        shares = [
            float(np.mean([_filled(layout, picture, tilted) for picture in pictures]))
            for tilted in (False, True)
        ]
        yield {
            "tilt (°)": tilt,
            "figures": len(areas),
            "filled as it is": shares[0],
            "filled when straightened": shares[1],
        }


def photographed(area: Area, tilt: float, towards: float, pixels: int = PIXELS) -> Image.Image:
    """A grey picture of a figure by a camera that is tilted towards a side, both in degrees."""
    low_x, low_y, high_x, high_y = area.bounds
    middle = np.array([low_x + high_x, low_y + high_y]) / 2.0
    width = max(high_x - low_x, high_y - low_y)
    lean, turn = np.radians(tilt), np.exp(1j * np.radians(towards))

    def seen(ring: Any) -> list[tuple[float, float]]:
        points: Floats = (np.asarray(ring.coords) - middle) / width
        z = (points @ np.array([1.0, 1j])) * turn.conj()
        depth = _DISTANCE - np.sin(lean) * z.real
        flat = (np.cos(lean) * z.real + 1j * z.imag) * turn * _DISTANCE / depth
        columns, rows = 0.5 + _WIDTH * flat.real, 0.5 - _WIDTH * flat.imag
        return [(float(x), float(y)) for x, y in zip(columns * size, rows * size, strict=True)]

    size = pixels * _FINE
    canvas = Image.new("L", (size, size), _PAPER)
    brush = ImageDraw.Draw(canvas)
    for part in shapely.get_parts(area).tolist():
        for ring, ink in ((part.exterior, _INK), *((hole, _PAPER) for hole in part.interiors)):
            brush.polygon(seen(ring), ink)
    return canvas.resize((pixels, pixels), Image.Resampling.BOX)


def _filled(layout: Layout, picture: Image.Image, tilted: bool) -> bool:
    """Whether tokens fill what the picture shows, by its pixels."""
    cover = find_silhouette(picture, layout, "the picture", tilted).cover
    view = float(np.sqrt(layout.areas.sum() / cover.mean()))
    return fill_picture(cover, layout, view, SECONDS).iou >= SOLVED
