"""Tokens as rigid bodies in PyBullet, carried through the air.

In engine units the arena always has width 2. The engine's tolerances, its limit of 100 units per
second and the camera suit bodies of this size.
"""

import math
from collections.abc import Sequence

import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.prisms import ENGINE_ARENA, inset, prism, thickness
from tangram_sim.geometry.shapes import Shape
from tangram_sim.sight.pictures import BACKGROUND, TOKEN_GRAY, averaged, taken_pixels
from tangram_sim.world.camera import Camera
from tangram_sim.world.engine import Client, pybullet

_HALF_HEIGHT = 0.01  # of a token in pictures
# Half height of a token's collision shape: so tall that the shortest way out of another token is
# always sideways. Carried tokens pass above.
_WALL = 0.25
_LIFTED = 3.0 * _WALL
# Without a margin the engine misses one overlap in four and pushes upwards. Collision shapes are
# smaller by the margin on every side, so that pieces that only touch do not push each other.
_MARGIN = 1e-4
_UPRIGHT = 1e4  # inertia about x and y, so large that no token tips over
# Friction of a token's edges. The engine multiplies those of both tokens: with 0.04 they glide and
# do not drag each other along.
_FRICTION = 0.2
_RECOVERY = 0.5  # share of an overlap that one step removes
_SETTLED = 1e-5  # deepest overlap that may stay
_SETTLE_STEPS, _SETTLE_S = 200, 1.0 / 240.0
_DISTANCE = 8  # index of the distance in the engine's contact points

# Simulation steps in an action of one second. A step is exact up to a rotation of pi / 4 and falls
# short beyond, so half a turn needs at least four.
_SUBSTEPS = 8

_Command = tuple[float, float, float]


class PhysicsWorld(Client):
    """A world of prisms in its own PyBullet client; see `World`.

    The bodies are made once and then only moved: `resetSimulation` in a loop leaks memory.
    """

    def __init__(self, layout: Layout, sim: SimConfig) -> None:
        self._unit = ENGINE_ARENA / sim.arena
        super().__init__()
        self._alone = layout.tokens == 1
        self._flipped: Bools = np.zeros(layout.tokens, dtype=np.bool_)
        self._bodies = [self._make_body(shape) for shape in layout.shapes]
        for body in self._bodies:
            self._keep_upright(body)
        self._play_at_once()
        if sim.pixels:
            self._pixels = sim.pixels
            shown = ENGINE_ARENA * sim.view
            self._camera = Camera(self.client, taken_pixels(sim), shown, _HALF_HEIGHT)

    def place(self, poses: Floats, flipped: Bools | None = None) -> None:
        """See `World.place`."""
        self._flipped[:] = False if flipped is None else flipped
        if not self._alone:
            self._forget_contacts()
        for token, (x, y, angle) in enumerate(np.asarray(poses).tolist()):
            self._put(token, x * self._unit, y * self._unit, angle)

    def move(self, token: int, velocity: Floats, flip: bool = False) -> None:
        """See `World.move`."""
        # All bodies rest between calls. `place` relies on the stop at the end of a move.
        self._lift(token, self._command(velocity), flip)

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
        return averaged(self._camera.picture(), self._pixels)

    def _command(self, velocity: Floats) -> _Command:
        x, y, angular = np.asarray(velocity, dtype=np.float64).tolist()
        return x * self._unit, y * self._unit, angular

    def _lift(self, token: int, command: _Command, flip: bool) -> None:
        """Carry a token above the others, set it down, and push overlapping tokens apart."""
        if self._alone:
            self._carry(token, command, flip, 0.0)
            return
        poses = [self._pose(other) for other in range(len(self._bodies))]
        self._carry(token, command, flip, _LIFTED)
        # Restore the others: overlaps that remain after settling make them creep meanwhile.
        poses[token] = self._pose(token)
        self._put_all(poses)
        self._settle()

    def _carry(self, token: int, command: _Command, flip: bool, height: float) -> None:
        """Move a token at a height for one second, then stop all tokens."""
        if flip or height:
            pose = self._pose(token)
            self._flipped[token] ^= flip
            self._put(token, *pose, height=height)
        self._set_velocity(token, *command)
        pybullet.stepSimulation(physicsClientId=self.client)
        self._stop_all()

    def _settle(self) -> None:
        """Push overlapping tokens apart, without momentum."""
        pybullet.performCollisionDetection(physicsClientId=self.client)
        self._play_steps_of(_SETTLE_S)
        for _ in range(_SETTLE_STEPS):
            if self._depth() <= _SETTLED:
                break
            pybullet.stepSimulation(physicsClientId=self.client)
            self._stop_all()
        self._play_at_once()

    def _forget_contacts(self) -> None:
        """Clear the engine's contacts by putting every token at a different height.

        The engine keeps contacts of pairs that move apart within the plane of the table. Contacts
        of the last episode would throw tokens of the next one through the arena.
        """
        for token in range(len(self._bodies)):
            self._put(token, 0.0, 0.0, 0.0, height=(token + 1) * _LIFTED)
        pybullet.performCollisionDetection(physicsClientId=self.client)

    def _depth(self) -> float:
        """The largest depth by which two tokens overlap, in engine units."""
        contacts = pybullet.getContactPoints(physicsClientId=self.client)
        return max((-contact[_DISTANCE] for contact in contacts), default=0.0)

    def _stop_all(self) -> None:
        for token in range(len(self._bodies)):
            self._set_velocity(token, 0.0, 0.0, 0.0)

    def _play_at_once(self) -> None:
        """Let one call of stepSimulation play the second of an action, in `_SUBSTEPS` steps."""
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=1.0,
            numSubSteps=_SUBSTEPS,
            contactERP=_RECOVERY,
            contactSlop=0.0,
            deterministicOverlappingPairs=1,
            physicsClientId=self.client,
        )

    def _play_steps_of(self, seconds: float) -> None:
        """Let one call of stepSimulation play one step of `seconds`."""
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=seconds, numSubSteps=0, physicsClientId=self.client
        )

    def _make_body(self, shape: Shape) -> int:
        corners = shape.corners * self._unit
        margin = min(_MARGIN, 0.2 * thickness(corners))
        collision = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=prism(inset(corners, margin), _WALL)[0],
            physicsClientId=self.client,
        )
        vertices, triangles = prism(corners, _HALF_HEIGHT)
        gray = TOKEN_GRAY / BACKGROUND
        visual = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=vertices,
            indices=triangles,
            rgbaColor=(gray, gray, gray, 1.0),
            physicsClientId=self.client,
        )
        mass = shape.area * self._unit**2
        body: int = pybullet.createMultiBody(mass, collision, visual, physicsClientId=self.client)
        pybullet.changeDynamics(
            body,
            -1,
            collisionMargin=margin,
            lateralFriction=_FRICTION,
            # With Bullet's default damping of 0.04 tokens would stop short.
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=self.client,
        )
        if self._alone:
            pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=self.client)
        return body

    def _keep_upright(self, body: int) -> None:
        """Let a body rotate about the vertical only, so that it never tips over."""
        mass, _, inertia, *_ = pybullet.getDynamicsInfo(body, -1, physicsClientId=self.client)
        pybullet.changeDynamics(
            body,
            -1,
            mass=mass,
            localInertiaDiagonal=(_UPRIGHT, _UPRIGHT, inertia[2]),
            physicsClientId=self.client,
        )

    def _set_velocity(self, token: int, x: float, y: float, angular: float) -> None:
        pybullet.resetBaseVelocity(
            self._bodies[token], (x, y, 0.0), (0.0, 0.0, angular), physicsClientId=self.client
        )

    def _put(self, token: int, x: float, y: float, angle: float, height: float = 0.0) -> None:
        """Set a token's pose in engine units, on the side that `_flipped` says."""
        cos, sin = math.cos(angle / 2.0), math.sin(angle / 2.0)
        pybullet.resetBasePositionAndOrientation(
            self._bodies[token],
            (x, y, height),
            (cos, sin, 0.0, 0.0) if self._flipped[token] else (0.0, 0.0, sin, cos),
            physicsClientId=self.client,
        )

    def _put_all(self, poses: Sequence[tuple[float, float, float]]) -> None:
        for other, pose in enumerate(poses):
            self._put(other, *pose)

    def _pose(self, token: int) -> tuple[float, float, float]:
        """Position in engine units, and the angle in (-pi, pi]."""
        (x, y, _), (a, b, c, d) = pybullet.getBasePositionAndOrientation(
            self._bodies[token], physicsClientId=self.client
        )
        sine, cosine = (b, a) if self._flipped[token] else (c, d)
        # q and -q are one rotation: with cosine >= 0 the angle lies in (-pi, pi].
        half = math.atan2(sine, cosine) if cosine >= 0.0 else math.atan2(-sine, -cosine)
        return x, y, 2.0 * half
