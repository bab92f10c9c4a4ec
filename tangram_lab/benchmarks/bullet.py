"""The bare PyBullet loop that the simulation is compared with: the engine, and nothing else."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pybullet

from tangram_sim.arrays import Floats
from tangram_sim.config import SimConfig
from tangram_sim.layout import Layout

HALF_HEIGHT = 0.01
CAMERA_HEIGHT = 100.0


class BareLoop:
    """Episodes of the same engine calls and pictures, with poses and velocities made beforehand.

    No drawing of layouts, no geometry, no reward, nothing recorded: what is left is what the engine
    costs whoever uses it.
    """

    def __init__(self, layout: Layout, sim: SimConfig, horizon: int) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=1.0, numSubSteps=sim.substeps, physicsClientId=self.client
        )
        unit = 2.0 / sim.arena
        self.bodies = [self._body(shape.corners * unit) for shape in layout.shapes]
        self.pixels = sim.pixels if sim.camera else 0
        self.horizon = horizon
        self.camera = _camera()
        rng = np.random.default_rng(0)
        self.poses = rng.uniform(-0.8, 0.8, (256, len(self.bodies), 3)).tolist()
        self.velocities = rng.uniform(-1.0, 1.0, (256, 3)).tolist()
        self.number = 0

    def close(self) -> None:
        """Free the engine."""
        pybullet.disconnect(self.client)

    def play(self) -> int:
        """One episode: the target's picture, the start, and each step with its picture."""
        if self.pixels:
            self._place()
            self._picture()
        self._place()
        for step in range(self.horizon):
            self._move(self.bodies[step % len(self.bodies)])
            for body in self.bodies:
                pybullet.getBasePositionAndOrientation(body, physicsClientId=self.client)
            if self.pixels:
                self._picture()
        return 1

    def _place(self) -> None:
        self.number += 1
        poses = self.poses[self.number % len(self.poses)]
        for body, (x, y, angle) in zip(self.bodies, poses, strict=True):
            turned = (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0))
            pybullet.resetBasePositionAndOrientation(
                body, (x, y, 0.0), turned, physicsClientId=self.client
            )

    def _move(self, body: int) -> None:
        x, y, turn = self.velocities[self.number % len(self.velocities)]
        pybullet.resetBaseVelocity(body, (x, y, 0.0), (0.0, 0.0, turn), physicsClientId=self.client)
        pybullet.stepSimulation(physicsClientId=self.client)
        pybullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0), physicsClientId=self.client)

    def _picture(self) -> Any:
        return pybullet.getCameraImage(
            self.pixels,
            self.pixels,
            *self.camera,
            shadow=0,
            lightAmbientCoeff=1.0,
            lightDiffuseCoeff=0.0,
            lightSpecularCoeff=0.0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self.client,
        )

    def _body(self, corners: Floats) -> int:
        heights = (-HALF_HEIGHT, HALF_HEIGHT)
        vertices = [[float(x), float(y), z] for z in heights for x, y in corners]
        shapes = {"vertices": vertices, "physicsClientId": self.client}
        collision = pybullet.createCollisionShape(pybullet.GEOM_MESH, **shapes)
        visual = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            indices=_triangles(len(corners)),
            rgbaColor=(0.3, 0.3, 0.3, 1.0),
            **shapes,
        )
        body = pybullet.createMultiBody(1.0, collision, visual, physicsClientId=self.client)
        pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=self.client)
        return int(body)


def _triangles(count: int) -> list[int]:
    top = [i for k in range(1, count - 1) for i in (count, count + k, count + k + 1)]
    bottom = [i for k in range(1, count - 1) for i in (0, k + 1, k)]
    sides = [
        i
        for k in range(count)
        for j in [(k + 1) % count]
        for i in (k, j, count + j, k, count + j, count + k)
    ]
    return top + bottom + sides


def _camera() -> tuple[Sequence[float], Sequence[float]]:
    view = pybullet.computeViewMatrix((0, 0, CAMERA_HEIGHT), (0, 0, 0), (0, 1, 0))
    angle = math.degrees(2.0 * math.atan(1.0 / CAMERA_HEIGHT))
    near_far = (CAMERA_HEIGHT - 10.0, CAMERA_HEIGHT + 10.0)
    return view, pybullet.computeProjectionMatrixFOV(angle, 1.0, *near_far)
