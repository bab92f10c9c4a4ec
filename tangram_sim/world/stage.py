"""Pictures of an arm at work, seen from the side.

Legend: K tokens, V corners.
"""

import math
from typing import Any

import numpy as np
from PIL import Image

from tangram_core.arrays import Bools, Floats
from tangram_sim.drawing.strokes import colour_of
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.prisms import ENGINE_ARENA, prism
from tangram_sim.world.arm import METRES, Panda
from tangram_sim.world.engine import pybullet

SIDE = (480, 300)  # pixels
_CAMERA, _LOOKS_AT, _SIGHT = (0.62, -0.5, 0.62), (-0.1, 0.0, 0.12), 46.0
_THICK = 0.015  # metres, of a token
_TABLE, _PLACE = (0.97, 0.97, 0.95), (0.86, 0.78, 0.62)


class Stage:
    """The visible scene around an arm: table, tokens, their target places and the peg."""

    def __init__(
        self, layout: Layout, arm: Panda, goals: Floats, present: Bools, finger: float
    ) -> None:
        """Add the scene to the client of the arm.

        Args:
            layout: the tokens.
            arm: the arm.
            goals: (V, 2) corners of the target, arena units.
            present: (K,) tokens that take part.
            finger: radius of the peg, arena units.
        """
        self._layout, self._arm = layout, arm
        half = ENGINE_ARENA / 2.0 * METRES
        board = self._shape(pybullet.GEOM_BOX, _TABLE, halfExtents=(half, half, 0.01))
        self._body(board, (0.0, 0.0, -0.012))
        self._tokens = {}
        places = layout.poses(goals)
        for token in np.flatnonzero(present).tolist():
            place = self._token(token, 1e-4, _PLACE)
            self._put(place, places[token], 0.0)
            colour = tuple(channel / 255.0 for channel in colour_of(token))
            self._tokens[token] = self._token(token, _THICK / 2.0, colour)
        peg = {"radius": finger * METRES, "length": 0.1}
        self._peg = self._body(self._shape(pybullet.GEOM_CYLINDER, (0.25, 0.25, 0.28), **peg))

    def seen(self, joints: Floats, tip: Floats, corners: Floats) -> Image.Image:
        """A picture of one moment: joints (7,), tip (3,) in metres, tokens' corners (V, 2)."""
        self._arm.at(joints.tolist())
        poses, (x, y, z) = self._layout.poses(corners), tip.tolist()
        for token, body in self._tokens.items():
            self._put(body, poses[token], _THICK / 2.0)
        self._call("resetBasePositionAndOrientation", self._peg, (x, y, z + 0.05), (0, 0, 0, 1))
        view = pybullet.computeViewMatrix(_CAMERA, _LOOKS_AT, (0.0, 0.0, 1.0))
        lens = pybullet.computeProjectionMatrixFOV(_SIGHT, SIDE[0] / SIDE[1], 0.05, 3.0)
        pixels = self._call("getCameraImage", *SIDE, view, lens, renderer=pybullet.ER_TINY_RENDERER)
        shown = np.reshape(pixels[2], (SIDE[1], SIDE[0], 4))[..., :3]
        return Image.fromarray(shown.astype(np.uint8))

    def _token(self, token: int, half: float, colour: tuple[float, ...]) -> int:
        corners = self._layout.shapes[token].corners * METRES
        vertices, triangles = prism(corners, half)
        # No two triangles share corners: shared ones would make the shading look round.
        mesh = {"vertices": [vertices[i] for i in triangles], "indices": [*range(len(triangles))]}
        return self._body(self._shape(pybullet.GEOM_MESH, colour, **mesh))

    def _put(self, body: int, pose: Floats, height: float) -> None:
        x, y, angle = pose.tolist()
        turn = (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0))
        place = (x * METRES, y * METRES, height)
        self._call("resetBasePositionAndOrientation", body, place, turn)

    def _shape(self, kind: int, colour: tuple[float, ...], **how: Any) -> int:
        shape: int = self._call("createVisualShape", kind, rgbaColor=(*colour, 1.0), **how)
        return shape

    def _body(self, shape: int, place: tuple[float, ...] = (0.0, 0.0, 0.0)) -> int:
        body: int = self._call("createMultiBody", 0.0, -1, shape, basePosition=place)
        return body

    def _call(self, name: str, *given: Any, **named: Any) -> Any:
        return getattr(pybullet, name)(*given, **named, physicsClientId=self._arm.client)
