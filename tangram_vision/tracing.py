"""An outline as an agent that plays by pictures sees it: what the camera shows of it, traced."""

import numpy as np
import shapely

from tangram_sim.areas import Area
from tangram_sim.arrays import Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.errors import ConfigError
from tangram_sim.layout import Layout
from tangram_sim.lens import View
from tangram_sim.rings import as_rows
from tangram_vision.levels import coverage
from tangram_vision.outlines import outline, ways_of
from tangram_vision.portraits import portrait


class PictureTracer:
    """Shows outlines to the camera, and finds them again in what that takes."""

    def __init__(self, layout: Layout, sim: SimConfig, rows: int) -> None:
        """Of a layout's tokens, in rows that travel."""
        self._layout, self._sim, self._rows = layout, sim, rows

    def portrait(self, area: Area, view: View) -> Pixels:
        """See `tangram_sim.sight.Tracer`."""
        return portrait(area, self._sim, view)

    def trace(self, picture: Pixels, generator: np.random.Generator) -> Floats:
        """See `tangram_sim.sight.Tracer`; in one of the ways that are tried to fill a picture."""
        nothing: Floats = np.zeros((self._rows, 2))
        cover = coverage(picture)
        if cover is None:
            return nothing
        ways, unit = ways_of(cover), self._sim.arena / len(cover)
        found = outline(cover, ways[int(generator.integers(len(ways)))])
        half = self._sim.arena / 2.0
        area = shapely.transform(found, lambda points: points * unit + (-half, half))
        try:
            return as_rows(area, self._layout, self._rows)
        except ConfigError:  # more corners than tokens leave
            return nothing
