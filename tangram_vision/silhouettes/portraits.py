"""An outline -> what the camera shows of it: a target of which no seam tells the pieces.

The engine draws tokens one by one, and where two meet it can leave out what lies between them.
"""

import numpy as np
import shapely

from tangram_core.arrays import Pixels
from tangram_sim.config import SimConfig
from tangram_sim.geometry.areas import Area
from tangram_sim.sight.pictures import BACKGROUND, TOKEN_GRAY, averaged, taken_pixels


def portrait(area: Area, sim: SimConfig) -> Pixels:
    """Picture (P, P) of an area.

    Args:
        area: arena units.
        sim: its camera.
    """
    side = taken_pixels(sim)
    centres = (np.arange(side) + 0.5) * (sim.arena / side) - sim.arena / 2.0
    inside = shapely.contains_xy(area, *np.meshgrid(centres, -centres))
    picture = np.where(inside, TOKEN_GRAY, BACKGROUND).astype(np.uint8)
    return averaged(picture, sim.pixels)
