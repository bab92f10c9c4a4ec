"""An outline -> what the camera shows of it: a target of which no seam tells the pieces.

The engine draws tokens one by one, and where two meet it can leave out what lies between them.
"""

import numpy as np
import shapely

from tangram_core.arrays import Pixels
from tangram_sim.config import SimConfig
from tangram_sim.geometry.areas import Area
from tangram_sim.sight.lens import View
from tangram_sim.sight.pictures import BACKGROUND, TOKEN_GRAY, averaged, taken_pixels


def portrait(area: Area, sim: SimConfig, view: View) -> Pixels:
    """Picture (P, P) of an area, before light, blur and noise.

    Args:
        area: arena units.
        sim: its camera.
        view: where that stands.
    """
    side = taken_pixels(sim)
    centres = (np.arange(side) + 0.5) * (sim.arena / side) - sim.arena / 2.0
    z = centres - 1j * centres[:, None]
    z = (view.x + 1j * view.y) + z * np.exp(1j * view.turn)
    low_x, low_y, high_x, high_y = area.bounds
    near = (low_x < z.real) & (z.real < high_x) & (low_y < z.imag) & (z.imag < high_y)
    picture = np.full((side, side), BACKGROUND, dtype=np.uint8)
    inside = shapely.contains_xy(area, z.real[near], z.imag[near])
    picture[near] = np.where(inside, TOKEN_GRAY, BACKGROUND)
    return averaged(picture, sim.pixels)
