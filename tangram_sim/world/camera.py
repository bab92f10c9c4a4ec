"""The engine's camera: it looks straight down on a square around the middle of the arena."""

import math

import numpy as np

from tangram_core.arrays import Pixels
from tangram_sim.world.engine import pybullet

# TinyRenderer draws nothing with an orthographic projection. From this height the perspective
# differs from it by less than a tenth of a pixel at 1024 pixels.
_CAMERA_HEIGHT = 100.0
_DEPTH = 10.0


class Camera:
    """A camera of one PyBullet client."""

    def __init__(self, client: int, pixels: int, width: float, top: float) -> None:
        """Point the camera down; `width` of the view and `top` of tokens are in engine units."""
        self._client = client
        self._pixels = pixels
        # TinyRenderer samples a pixel at its lower left corner. The camera stands half a pixel to
        # the right and up, so that a pixel shows its centre.
        shift, height = width / pixels / 2.0, _CAMERA_HEIGHT + top
        self._view = pybullet.computeViewMatrix(
            (shift, shift, height), (shift, shift, 0.0), (0.0, 1.0, 0.0)
        )
        self._projection = pybullet.computeProjectionMatrixFOV(
            math.degrees(2.0 * math.atan(width / 2.0 / _CAMERA_HEIGHT)),
            1.0,
            _CAMERA_HEIGHT - _DEPTH,
            _CAMERA_HEIGHT + _DEPTH,
        )

    def picture(self) -> Pixels:
        """Grayscale picture (P, P), see `World.picture`."""
        image = pybullet.getCameraImage(
            self._pixels,
            self._pixels,
            self._view,
            self._projection,
            shadow=0,
            # Ambient light only: tokens have a uniform gray, as in the kinematic world.
            lightAmbientCoeff=1.0,
            lightDiffuseCoeff=0.0,
            lightSpecularCoeff=0.0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client,
        )
        colours = np.asarray(image[2], dtype=np.uint8).reshape(self._pixels, self._pixels, 4)
        # Tokens and background are gray, so one channel is the grayscale picture.
        return colours[..., 0].copy()
