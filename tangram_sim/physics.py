"""Tokens as rigid bodies in PyBullet: the only module that imports the engine.

The engine always sees an arena of width 2, whatever the arena's unit: its tolerances, its limit of
100 units a second and the camera are made for bodies of about that size.
"""

import math
import weakref
from collections.abc import Sequence

import numpy as np
import pybullet

from tangram_sim.arrays import Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.errors import TangramError
from tangram_sim.layout import Layout
from tangram_sim.pictures import BACKGROUND, TOKEN_GRAY

_ENGINE_ARENA = 2.0
_HALF_HEIGHT = 0.01
# TinyRenderer draws nothing with an orthographic projection. From this far above, the picture of
# the arena differs from one by less than a tenth of a pixel at 1024 pixels.
_CAMERA_HEIGHT = 100.0
_DEPTH = 10.0


class PhysicsWorld:
    """Prisms in one PyBullet client of their own, in DIRECT mode. See `World`.

    The bodies are made once and only moved: `resetSimulation` in a loop leaks memory.
    """

    def __init__(self, layout: Layout, sim: SimConfig) -> None:
        self._pixels = sim.pixels
        self._unit = _ENGINE_ARENA / sim.arena
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise TangramError(
                "PyBullet has no client left (it offers 1024 in one process): "
                "close environments, or use fewer of them"
            )
        self._finalizer = weakref.finalize(self, pybullet.disconnect, self._client)
        # One call of stepSimulation plays the second of an action, in `substeps` steps.
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=1.0, numSubSteps=sim.substeps, physicsClientId=self._client
        )
        self._damping = sim.damping
        self._bodies = [self._make_body(s.corners * self._unit) for s in layout.shapes]
        self._view, self._projection = _camera(sim.pixels)

    def place(self, poses: Floats) -> None:
        """See `World.place`."""
        for body, (x, y, angle) in zip(self._bodies, np.asarray(poses).tolist(), strict=True):
            pybullet.resetBasePositionAndOrientation(
                body,
                (x * self._unit, y * self._unit, 0.0),
                (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0)),
                physicsClientId=self._client,
            )

    def move(self, token: int, velocity: Floats) -> None:
        """See `World.move`."""
        # Every body rests between calls: `place` relies on the stop at the end.
        x, y, angular = np.asarray(velocity, dtype=np.float64).tolist()
        self._set_velocity(self._bodies[token], x * self._unit, y * self._unit, angular)
        pybullet.stepSimulation(physicsClientId=self._client)
        self._set_velocity(self._bodies[token], 0.0, 0.0, 0.0)

    def poses(self) -> Floats:
        """See `World.poses`."""
        return np.array([self._pose(body) for body in self._bodies])

    def picture(self) -> Pixels:
        """See `World.picture`."""
        image = pybullet.getCameraImage(
            self._pixels,
            self._pixels,
            self._view,
            self._projection,
            shadow=0,
            # Even light from everywhere: a token has one gray, as in the kinematic world.
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

    def close(self) -> None:
        """See `World.close`."""
        self._finalizer()

    def _make_body(self, corners: Floats) -> int:
        vertices, triangles = _prism(corners)
        collision = pybullet.createCollisionShape(
            pybullet.GEOM_MESH, vertices=vertices, physicsClientId=self._client
        )
        gray = TOKEN_GRAY / BACKGROUND
        visual = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=vertices,
            indices=triangles,
            rgbaColor=(gray, gray, gray, 1.0),
            physicsClientId=self._client,
        )
        body: int = pybullet.createMultiBody(1.0, collision, visual, physicsClientId=self._client)
        # Bullet damps by 0.04 unless told otherwise: tokens would stop short.
        pybullet.changeDynamics(
            body,
            -1,
            linearDamping=self._damping,
            angularDamping=self._damping,
            physicsClientId=self._client,
        )
        # Tokens pass through each other for now: no group, no mask.
        pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=self._client)
        return body

    def _set_velocity(self, body: int, x: float, y: float, angular: float) -> None:
        pybullet.resetBaseVelocity(
            body, (x, y, 0.0), (0.0, 0.0, angular), physicsClientId=self._client
        )

    def _pose(self, body: int) -> tuple[float, float, float]:
        (x, y, _), (_, _, sine, cosine) = pybullet.getBasePositionAndOrientation(
            body, physicsClientId=self._client
        )
        # q and -q are one rotation: with cosine >= 0 the angle lies in (-pi, pi].
        half = math.atan2(sine, cosine) if cosine >= 0.0 else math.atan2(-sine, -cosine)
        return x / self._unit, y / self._unit, 2.0 * half


def _prism(corners: Floats) -> tuple[list[list[float]], list[int]]:
    """Vertices and triangles of the prism over a convex polygon (V, 2)."""
    count = len(corners)
    heights = (-_HALF_HEIGHT, _HALF_HEIGHT)
    vertices = [[float(x), float(y), z] for z in heights for x, y in corners]
    triangles: list[int] = []
    for i in range(1, count - 1):
        triangles += [count, count + i, count + i + 1, 0, i + 1, i]
    for i in range(count):
        j = (i + 1) % count
        triangles += [i, j, count + j, i, count + j, count + i]
    return vertices, triangles


def _camera(pixels: int) -> tuple[Sequence[float], Sequence[float]]:
    """View and projection matrices of a camera that sees exactly the arena from above."""
    # TinyRenderer samples a pixel at its lower left corner, so the camera stands half a pixel to
    # the right and up: then a pixel shows its centre.
    shift = _ENGINE_ARENA / pixels / 2.0
    eye = (shift, shift, _CAMERA_HEIGHT + _HALF_HEIGHT)
    view = pybullet.computeViewMatrix(eye, (shift, shift, 0.0), (0.0, 1.0, 0.0))
    projection = pybullet.computeProjectionMatrixFOV(
        math.degrees(2.0 * math.atan(_ENGINE_ARENA / 2.0 / _CAMERA_HEIGHT)),
        1.0,
        _CAMERA_HEIGHT - _DEPTH,
        _CAMERA_HEIGHT + _DEPTH,
    )
    return view, projection
