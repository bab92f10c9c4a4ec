"""Silhouettes photographed aslant: a camera looks at the middle of a figure, tilted to any side."""

from typing import Any

import numpy as np
import shapely
from PIL import Image, ImageDraw

from tangram_core.arrays import Floats
from tangram_sim.geometry.areas import Area

PIXELS = 512
_WIDTH = 0.6  # of the picture that a figure takes
_DISTANCE = 1.6  # widths of the figure, from which a telephone's camera shows it so large
_FINE = 4  # points along a pixel
_INK, _PAPER = 50, 225


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
