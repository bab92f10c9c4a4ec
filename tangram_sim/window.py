"""A window in which one can watch tokens move."""

import math
import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from tangram_sim.arrays import Bools, Floats
from tangram_sim.errors import TangramError
from tangram_sim.layout import Layout
from tangram_sim.prisms import ENGINE_ARENA, prism

# Tokens thick enough to be seen from the side, over a flat target.
_SHOWN_HALF_HEIGHT, _FLAT_HALF_HEIGHT = 0.03, 0.001
_PATIENCE_S = 30.0  # with a display that does not answer
_OUT_OF_SIGHT = (0.0, 0.0, -1e4)  # until it is told where to lie
_PAPER = " ".join(
    f"--background_color_{name}={value}"
    for name, value in (("red", 0.98), ("green", 0.98), ("blue", 0.97))
)


class Window:
    """A window of the engine that shows tokens over their target; nothing moves there by itself."""

    def __init__(
        self, engine: Any, layout: Layout, arena: float, colours: Sequence[Sequence[float]]
    ) -> None:
        """Open the window.

        Args:
            engine: the module pybullet, which only `physics` imports.
            layout: the tokens.
            arena: width of the arena, shown as 2 units of the engine.
            colours: red, green and blue in [0, 1] of each token, and behind them the target's.

        Raises:
            TangramError: no display.
        """
        _check_display(engine)
        self._engine = engine
        self._unit = ENGINE_ARENA / arena
        self._client = self._engine.connect(self._engine.GUI, options=_PAPER)
        for flag in (self._engine.COV_ENABLE_GUI, self._engine.COV_ENABLE_MOUSE_PICKING):
            self._engine.configureDebugVisualizer(flag, 0, physicsClientId=self._client)
        self._engine.resetDebugVisualizerCamera(
            1.9, 0, -65, (0, -0.1, 0), physicsClientId=self._client
        )
        shapes = [shape.corners * self._unit for shape in layout.shapes]
        self._tokens = [
            self._body(corners, _SHOWN_HALF_HEIGHT, colour)
            for corners, colour in zip(shapes, colours, strict=False)
        ]
        self._target = [self._body(corners, _FLAT_HALF_HEIGHT, colours[-1]) for corners in shapes]

    @property
    def is_open(self) -> bool:
        """Whether the window is still open."""
        return bool(self._engine.isConnected(self._client))

    def show(self, poses: Floats, rolls: Floats, heights: Floats) -> None:
        """Show the tokens at these poses.

        Args:
            poses: (K, 3) x, y (arena units) and angle.
            rolls: (K,) radians by which they are turned over about their body's x axis.
            heights: (K,) above the table, 1 for half of the arena.
        """
        for body, pose, roll, height in zip(self._tokens, poses, rolls, heights, strict=True):
            # So that they lie on the table, and not half in it.
            self._put(body, pose, float(roll), _SHOWN_HALF_HEIGHT + float(height))

    def show_target(self, poses: Floats, flipped: Bools) -> None:
        """Lay the target below the tokens: poses (K, 3) and sides (K,)."""
        for body, pose, side in zip(self._target, poses, flipped, strict=True):
            self._put(body, pose, math.pi * float(side), -_FLAT_HALF_HEIGHT)

    def close(self) -> None:
        """Close the window; calling it twice does no harm."""
        if self.is_open:
            self._engine.disconnect(self._client)

    def _body(self, corners: Floats, half_height: float, colour: Sequence[float]) -> int:
        vertices, triangles = prism(corners, half_height)
        # Corners of their own for every triangle: flat faces, sharp edges.
        corner = np.array(vertices)[triangles].reshape(-1, 3, 3)
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        visual = self._engine.createVisualShape(
            self._engine.GEOM_MESH,
            vertices=corner.reshape(-1, 3).tolist(),
            indices=list(range(len(triangles))),
            normals=np.repeat(normal, 3, axis=0).tolist(),
            rgbaColor=(*colour, 1.0),
            specularColor=(0.0, 0.0, 0.0),
            physicsClientId=self._client,
        )
        body: int = self._engine.createMultiBody(
            0.0, -1, visual, basePosition=_OUT_OF_SIGHT, physicsClientId=self._client
        )
        return body

    def _put(self, body: int, pose: Floats, roll: float, height: float) -> None:
        x, y, angle = (float(value) for value in pose)
        turn = self._engine.getQuaternionFromEuler((roll, 0.0, angle))
        place = (x * self._unit, y * self._unit, height)
        self._engine.resetBasePositionAndOrientation(
            body, place, turn, physicsClientId=self._client
        )


def _check_display(engine: Any) -> None:
    """Refuse what the engine would end this process for: a child process tries it first."""
    attempt = f"import {engine.__name__} as e; e.disconnect(e.connect(e.GUI))"
    try:
        subprocess.run(
            [sys.executable, "-c", attempt], capture_output=True, check=True, timeout=_PATIENCE_S
        )
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
        display = os.environ.get("DISPLAY")
        why = f"none answers at DISPLAY={display}" if display else "DISPLAY is not set"
        raise TangramError(
            f"live=true needs a display ({why}): log in with one, or leave live out and write a "
            "film"
        ) from None
