"""Tokens as rigid bodies in PyBullet: the only module that imports the engine.

The engine always sees an arena of width 2, whatever the arena's unit: its tolerances, its limit of
100 units a second and the camera are made for bodies of about that size.
"""

import math
import weakref
from collections.abc import Sequence

import numpy as np
import pybullet

from tangram_sim.arrays import Bools, Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.errors import TangramError
from tangram_sim.layout import Layout
from tangram_sim.pictures import BACKGROUND, TOKEN_GRAY
from tangram_sim.shapes import Shape

_ENGINE_ARENA = 2.0
_HALF_HEIGHT = 0.01  # of a token as it is drawn
# Of a token as it collides, where there are others: so tall that the shortest way out of another
# is always sideways. Carried tokens pass above that.
_WALL = 0.25
_LIFTED = 3.0 * _WALL
_UPRIGHT = 1e4  # inertia about x and y, far more than a token's: none tips over
_FRICTION = 0.2  # between the edges of tokens
_GRIP = 1e3  # mass of the token that is pushed along the table, as a multiple of its own
_STRIDE = 0.02  # longest way of any of its points in one step, a fifth of the smallest token
_RECOVERY = 0.5  # share of an overlap that one step removes while tokens settle
_SETTLED = 1e-5  # deepest overlap that stays
_SETTLE_STEPS, _SETTLE_S = 100, 1.0 / 240.0
# TinyRenderer draws nothing with an orthographic projection. From this far above, the picture of
# the arena differs from one by less than a tenth of a pixel at 1024 pixels.
_CAMERA_HEIGHT = 100.0
_DEPTH = 10.0
_DISTANCE = 8  # of two bodies, in what the engine tells of a contact

_Command = tuple[float, float, float]


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
        self._substeps, self._damping = sim.substeps, sim.damping
        self._slides, self._alone = sim.motion == "slide", layout.tokens == 1
        self._radius = [shape.radius * self._unit for shape in layout.shapes]
        self._flipped: Bools = np.zeros(layout.tokens, dtype=np.bool_)
        self._bodies = [self._make_body(shape) for shape in layout.shapes]
        self._masses = [self._mass(body) for body in self._bodies]
        for token in range(layout.tokens):
            self._weigh(token, 1.0)
        self._play_at_once()
        self._view, self._projection = _camera(sim.pixels)

    def place(self, poses: Floats, flipped: Bools | None = None) -> None:
        """See `World.place`."""
        self._flipped[:] = False if flipped is None else flipped
        for token, (x, y, angle) in enumerate(np.asarray(poses).tolist()):
            self._put(token, x * self._unit, y * self._unit, angle)

    def move(self, token: int, velocity: Floats, flip: bool = False) -> None:
        """See `World.move`."""
        # Every body rests between calls: `place` relies on the stop at the end.
        x, y, angular = np.asarray(velocity, dtype=np.float64).tolist()
        command = x * self._unit, y * self._unit, angular
        if self._slides and not self._alone:
            self._slide(token, command)
        else:
            self._lift(token, command, flip)

    def poses(self) -> Floats:
        """See `World.poses`."""
        poses = np.array([self._pose(token) for token in range(len(self._bodies))])
        poses[:, :2] /= self._unit
        return poses

    def flipped(self) -> Bools:
        """See `World.flipped`."""
        return self._flipped.copy()

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

    def _lift(self, token: int, command: _Command, flip: bool) -> None:
        """Carry a token above the others and set it down; what it comes to lie in gives way."""
        if flip or not self._alone:
            pose = self._pose(token)
            self._flipped[token] ^= flip
            self._put(token, *pose, height=0.0 if self._alone else _LIFTED)
        self._set_velocity(token, *command)
        pybullet.stepSimulation(physicsClientId=self._client)
        self._set_velocity(token, 0.0, 0.0, 0.0)
        if not self._alone:
            self._put(token, *self._pose(token))
            self._settle()

    def _slide(self, token: int, command: _Command) -> None:
        """Push a token along the table, at its velocity whatever is in its way.

        The table's friction stops the others as soon as nothing pushes them.
        """
        x, y, angular = command
        way = math.hypot(x, y) + abs(angular) * self._radius[token]
        steps = max(self._substeps, math.ceil(way / _STRIDE))
        self._weigh(token, _GRIP)
        self._play_steps_of(1.0 / steps)
        for _ in range(steps):
            self._set_velocity(token, x, y, angular)
            pybullet.stepSimulation(physicsClientId=self._client)
            self._stop_all()
        self._settle()
        self._weigh(token, 1.0)

    def _settle(self) -> None:
        """Push tokens that lie in each other apart, both of them, without momentum."""
        pybullet.performCollisionDetection(physicsClientId=self._client)
        self._play_steps_of(_SETTLE_S)
        for _ in range(_SETTLE_STEPS):
            if self._depth() <= _SETTLED:
                break
            pybullet.stepSimulation(physicsClientId=self._client)
            self._stop_all()
        self._play_at_once()

    def _depth(self) -> float:
        """How deep the two tokens lie in each other that do so most."""
        contacts = pybullet.getContactPoints(physicsClientId=self._client)
        return max((-contact[_DISTANCE] for contact in contacts), default=0.0)

    def _stop_all(self) -> None:
        for token in range(len(self._bodies)):
            self._set_velocity(token, 0.0, 0.0, 0.0)

    def _play_at_once(self) -> None:
        """Let one call of stepSimulation play the second of an action, in `substeps` steps."""
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=1.0,
            numSubSteps=self._substeps,
            contactERP=_RECOVERY,
            physicsClientId=self._client,
        )

    def _play_steps_of(self, seconds: float) -> None:
        """Let one call of stepSimulation play one step of so long."""
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=seconds, numSubSteps=0, physicsClientId=self._client
        )

    def _make_body(self, shape: Shape) -> int:
        corners = shape.corners * self._unit
        collision = pybullet.createCollisionShape(
            pybullet.GEOM_MESH, vertices=_prism(corners, _WALL)[0], physicsClientId=self._client
        )
        vertices, triangles = _prism(corners, _HALF_HEIGHT)
        gray = TOKEN_GRAY / BACKGROUND
        visual = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=vertices,
            indices=triangles,
            rgbaColor=(gray, gray, gray, 1.0),
            physicsClientId=self._client,
        )
        mass = shape.area * self._unit**2
        body: int = pybullet.createMultiBody(mass, collision, visual, physicsClientId=self._client)
        # Bullet damps by 0.04 unless told otherwise: tokens would stop short.
        pybullet.changeDynamics(
            body,
            -1,
            linearDamping=self._damping,
            angularDamping=self._damping,
            # Without a margin pieces that only touch leave each other alone.
            collisionMargin=0.0,
            lateralFriction=_FRICTION,
            physicsClientId=self._client,
        )
        if self._alone:
            pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=self._client)
        return body

    def _mass(self, body: int) -> tuple[float, float]:
        """Mass, and inertia about the vertical."""
        info = pybullet.getDynamicsInfo(body, -1, physicsClientId=self._client)
        return info[0], info[2][2]

    def _weigh(self, token: int, times: float) -> None:
        """Make a token so many times as heavy as it is."""
        mass, inertia = self._masses[token]
        pybullet.changeDynamics(
            self._bodies[token],
            -1,
            mass=mass * times,
            localInertiaDiagonal=(_UPRIGHT * times, _UPRIGHT * times, inertia * times),
            physicsClientId=self._client,
        )

    def _set_velocity(self, token: int, x: float, y: float, angular: float) -> None:
        pybullet.resetBaseVelocity(
            self._bodies[token], (x, y, 0.0), (0.0, 0.0, angular), physicsClientId=self._client
        )

    def _put(self, token: int, x: float, y: float, angle: float, height: float = 0.0) -> None:
        """Put a token where it is told, in engine units, on the side that it lies on."""
        cos, sin = math.cos(angle / 2.0), math.sin(angle / 2.0)
        pybullet.resetBasePositionAndOrientation(
            self._bodies[token],
            (x, y, height),
            (cos, sin, 0.0, 0.0) if self._flipped[token] else (0.0, 0.0, sin, cos),
            physicsClientId=self._client,
        )

    def _pose(self, token: int) -> tuple[float, float, float]:
        """Position in engine units, and the angle in (-pi, pi]."""
        (x, y, _), (a, b, c, d) = pybullet.getBasePositionAndOrientation(
            self._bodies[token], physicsClientId=self._client
        )
        sine, cosine = (b, a) if self._flipped[token] else (c, d)
        # q and -q are one rotation: with cosine >= 0 the angle lies in (-pi, pi].
        half = math.atan2(sine, cosine) if cosine >= 0.0 else math.atan2(-sine, -cosine)
        return x, y, 2.0 * half


def _prism(corners: Floats, half_height: float) -> tuple[list[list[float]], list[int]]:
    """Vertices and triangles of the prism over a convex polygon (V, 2)."""
    count = len(corners)
    heights = (-half_height, half_height)
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
