"""Exact rigid motion without an engine, for tests, oracles and machines without PyBullet."""

import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.sight.pictures import photograph


class KinematicWorld:
    """A world where tokens move exactly as commanded, without contacts; see `World`."""

    def __init__(self, layout: Layout, sim: SimConfig) -> None:
        self._layout = layout
        self._sim = sim
        self._poses: Floats = np.zeros((layout.tokens, 3))
        self._flipped: Bools = np.zeros(layout.tokens, dtype=np.bool_)

    def place(self, poses: Floats, flipped: Bools | None = None) -> None:
        """See `World.place`."""
        self._poses[:] = poses
        self._poses[:, 2] = wrap(self._poses[:, 2])
        self._flipped[:] = False if flipped is None else flipped

    def move(self, token: int, velocity: Floats, flip: bool = False) -> None:
        """See `World.move`."""
        self._flipped[token] ^= flip
        self._poses[token] += velocity
        self._poses[token, 2] = wrap(self._poses[token, 2])

    def poses(self) -> Floats:
        """See `World.poses`."""
        return self._poses.copy()

    def flipped(self) -> Bools:
        """See `World.flipped`."""
        return self._flipped.copy()

    def picture(self) -> Pixels:
        """See `World.picture`."""
        corners = self._layout.corners(self._poses, self._flipped)
        return photograph(corners, self._layout, self._sim)

    def close(self) -> None:
        """See `World.close`."""


def wrap(angle: Floats) -> Floats:
    """An angle (radians) wrapped to (-pi, pi]."""
    wrapped: Floats = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return wrapped
