"""Corners of tokens, found in the pictures of a camera above the table.

Legend: K tokens, V corners.
"""

import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.sight.perception import Look, Sight
from tangram_sim.sight.pictures import coverage, photograph
from tangram_tasks.push.places import ARENA, part
from tangram_vision.pictures.seeing import see


class Camera:
    """Finder of the tokens of one table in pictures from above."""

    def __init__(self, layout: Layout, pixels: int) -> None:
        self._layout = layout
        self._sim = SimConfig(arena=ARENA, pixels=pixels, observe="pictures")

    def begin(self, corners: Floats, present: Bools) -> Floats:
        """Begin an episode; returns corners (V, 2) as seen. `present` (K,): tokens on the table."""
        self._tokens = np.flatnonzero(present)
        self._rows = present[self._layout.token_of_corner]
        self._part = own = part(self._layout, tuple(self._tokens.tolist()))

        def look(picture: Pixels) -> Look:
            return see(coverage(picture), own, ARENA)

        self._sight = Sight(own, look, 1, ARENA)
        picture, own_corners = self._picture(corners), corners[None, self._rows]
        self._sight.begin(picture, picture, own_corners, own.poses(own_corners))
        return self._as_seen(corners)

    def after(self, corners: Floats, pushed: int) -> Floats:
        """Corners (V, 2) as seen after a token was pushed; equal tokens keep their numbers."""
        moved = np.flatnonzero(self._tokens == pushed)
        self._sight.follow(self._picture(corners), moved, np.zeros((1, 3)))
        return self._as_seen(corners)

    def _picture(self, corners: Floats) -> Pixels:
        """A picture (1, P, P) from above."""
        return photograph(corners[self._rows], self._part, self._sim)[None]

    def _as_seen(self, corners: Floats) -> Floats:
        seen = corners.copy()
        seen[self._rows] = self._sight.corners[0]
        return seen
