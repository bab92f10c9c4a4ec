"""The simulation against a bare PyBullet loop with the same steps and pictures."""

import math
from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.run.service import ServiceConfig
from tangram_core.seeding import episode_generator
from tangram_core.setup import Setup
from tangram_lab.benchmarks.measure import Bound, Row, compare
from tangram_lab.benchmarks.setups import place, preset, several, with_sim
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.sight.pictures import taken_pixels
from tangram_sim.world.engine import pybullet

# A bare PyBullet loop


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
            fixedTimeStep=1.0, numSubSteps=sim.dynamics.substeps, physicsClientId=self.client
        )
        unit = 2.0 / sim.arena
        self.bodies = [self._body(shape.corners * unit) for shape in layout.shapes]
        self.pixels, self.looks = taken_pixels(sim), sim.looks
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
        """One episode: the target's picture, the start, and each step with its picture.

        Where tokens are looked for, the start has a picture too.
        """
        if self.pixels:
            self._place()
            self._picture()
        self._place()
        if self.looks:
            self._picture()
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


# Ours against it


ENVS = ServiceConfig().envs
PIXELS = (64, 128)
SEEN_PX = 128
TARGET = Bound(least=0.85)


def measure_sim(runs: int) -> list[Row]:
    """Episodes per second: drawn, played, photographed and rewarded, against the engine alone.

    Both take the same pictures: where tokens are seen, 16 times the pixels, which are averaged.
    """
    rows = []
    for count, setup in ((1, preset()), (7, several(7))):
        for pixels in PIXELS:
            case = f"{_tokens(count)}, {pixels} px"
            rows.append(_row(case, with_sim(setup, pixels=pixels), runs, TARGET))
        rows.append(_row(f"{_tokens(count)}, no pictures", with_sim(setup, pixels=0), runs))
        seen = with_sim(setup, pixels=SEEN_PX, picture="grey", observe="pictures")
        rows.append(_row(f"{_tokens(count)}, {SEEN_PX} px grey, seen", seen, runs))
    return rows


def _tokens(count: int) -> str:
    return "1 token" if count == 1 else f"{count} tokens"


def _row(case: str, setup: Setup, runs: int, bound: Bound | None = None) -> Row:
    labels = ("sim", case, "episodes/s")
    with closing(Episodes(setup)) as ours, closing(_bare(setup)) as bare:
        return compare(labels, ours.play, ("bare PyBullet", bare.play), runs, bound)


def _bare(setup: Setup) -> BareLoop:
    task = place(setup)
    return BareLoop(task.layout, task.sim, task.horizon)


class Episodes:
    """Whole episodes with actions drawn beforehand, as many at a time as a worker plays."""

    def __init__(self, setup: Setup) -> None:
        task = place(setup)
        self.env = task.make(ENVS).world
        rng = np.random.default_rng(0)
        self.actions = rng.uniform(-0.5, 0.5, (task.horizon, ENVS, task.action_size))
        if task.layout.tokens > 1:
            moved = (2.0 * np.arange(task.horizon) + 1.0) / task.horizon - 1.0
            self.actions[..., 0] = moved[:, None]
        self.number = 0

    def close(self) -> None:
        """Free the engines."""
        self.env.close()

    def play(self) -> int:
        """One episode in every environment."""
        first, self.number = self.number, self.number + ENVS
        numbers = range(first, first + ENVS)
        self.env.reset([episode_generator(0, "player", 0, 1, number) for number in numbers])
        for actions in self.actions:
            self.env.step(actions)
        return ENVS
