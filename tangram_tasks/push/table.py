"""Tokens on a table in PyBullet, and a finger that pushes them.

Lengths are arena units, in which the table is 2 wide. A push is slow: a token stops as soon as
nothing pushes it. Such motion is the same however fast time runs, as long as friction is much more
than inertia; so the engine's finger is quick and its gravity strong, and a push takes few steps.

Legend: K tokens.
"""

import math
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np

from tangram_core.arrays import Bools, Floats
from tangram_core.errors import TangramError
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.prisms import inset, prism
from tangram_sim.world.engine import pybullet

_HALF_HEIGHT = 0.05  # of a token
_MARGIN = 1e-3  # of what collides, which is smaller by it on every side
_SPEED = 1.0  # of the finger, units/s
_GRAVITY = 100.0  # units/s^2: a token that is let go stops within _SPEED^2 / (2 mu _GRAVITY)
_STEP_S = 1.0 / 120.0
_REST_STEPS = 8  # until nothing moves any more
_FORCE = 1e4  # of the finger's motors: nothing that is pushed slows it down
_ABOVE = 1.0  # height of the finger while it does not push
_NONE, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What is drawn for an episode, and told to nobody.

    Attributes:
        table: (K,) coefficients of friction of table and token.
        finger: of finger and token.
        centres: (K, 2) from each token's centre of area to its centre of mass, in its own frame.
    """

    table: Floats
    finger: float
    centres: Floats


class PushTable:
    """Bodies in one PyBullet client of their own, in DIRECT mode."""

    def __init__(self, layout: Layout, finger: float) -> None:
        """Make an empty table.

        Args:
            layout: the tokens.
            finger: its radius.
        """
        self._layout, self._finger = layout, finger
        self._prisms = [
            prism(inset(shape.corners, _MARGIN), _HALF_HEIGHT - _MARGIN)[0]
            for shape in layout.shapes
        ]
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise TangramError(
                "PyBullet has no client left (it offers 1024 in one process): close environments, "
                "or use fewer of them"
            )
        self._finalizer = weakref.finalize(self, pybullet.disconnect, self._client)
        self._bodies: dict[int, int] = {}  # token -> body

    def place(self, poses: Floats, present: Bools, unknowns: Unknowns) -> None:
        """Lay the tokens (K, 3) that are present on an empty table.

        All is made anew: the engine keeps something of every contact, and an episode must not hang
        on the one before it.
        """
        self._call("resetSimulation")
        self._call("setGravity", 0.0, 0.0, -_GRAVITY)
        self._call("setPhysicsEngineParameter", deterministicOverlappingPairs=1)
        ground, self._pusher = self._make_ground(), self._make_finger(unknowns.finger)
        self._call("setCollisionFilterPair", ground, self._pusher, -1, 2, 0)
        self._centres = unknowns.centres
        self._bodies = {
            token: self._make_token(token, float(unknowns.table[token]))
            for token in np.flatnonzero(present).tolist()
        }
        for token in self._bodies:
            self._put(token, poses[token])

    def push(self, begin: Floats, way: Floats) -> None:
        """Bring the finger down at `begin` (2,), move it by `way` (2,), and lift it."""
        length = math.hypot(*way)
        self._finger_at(begin[0], begin[1], 0.0)
        self._drive(way[0] / length * _SPEED, way[1] / length * _SPEED)
        self._run(max(1, math.ceil(length / _SPEED / _STEP_S)), length / _SPEED)
        self._finger_at(0.0, 0.0, _ABOVE)
        self._drive(0.0, 0.0)
        self._run(_REST_STEPS, _REST_STEPS * _STEP_S)
        for token in self._bodies:
            self._put(token, self._pose(token))

    def poses(self) -> Floats:
        """(K, 3) x, y and angle of every token; zeros of those that are away."""
        poses = np.zeros((self._layout.tokens, 3))
        for token in self._bodies:
            poses[token] = self._pose(token)
        return poses

    def close(self) -> None:
        """End the client; calling it twice does no harm."""
        self._finalizer()

    def _call(self, name: str, *given: Any, **named: Any) -> Any:
        return getattr(pybullet, name)(*given, **named, physicsClientId=self._client)

    def _run(self, steps: int, seconds: float) -> None:
        self._call("setPhysicsEngineParameter", fixedTimeStep=seconds, numSubSteps=steps)
        self._call("stepSimulation")

    def _finger_at(self, x: float, y: float, height: float) -> None:
        for joint, value in enumerate((x, y, height)):
            self._call("resetJointState", self._pusher, joint, value, 0.0)

    def _drive(self, x: float, y: float) -> None:
        self._call(
            "setJointMotorControlArray",
            self._pusher,
            (0, 1, 2),
            pybullet.VELOCITY_CONTROL,
            targetVelocities=(x, y, 0.0),
            forces=(_FORCE, _FORCE, _FORCE),
        )

    def _put(self, token: int, pose: Floats) -> None:
        """Lay a token down, at rest; the engine asks where its centre of mass is."""
        x, y, angle = np.asarray(pose).tolist()
        right, up = self._shift(token, angle)
        place = (x + right, y + up, _HALF_HEIGHT)
        turn = (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0))
        self._call("resetBasePositionAndOrientation", self._bodies[token], place, turn)
        self._call("resetBaseVelocity", self._bodies[token], _NONE, _NONE)

    def _pose(self, token: int) -> Floats:
        (x, y, _), (_, _, c, d) = self._call("getBasePositionAndOrientation", self._bodies[token])
        angle = 2.0 * (math.atan2(c, d) if d >= 0.0 else math.atan2(-c, -d))
        right, up = self._shift(token, angle)
        return np.array([x - right, y - up, angle])

    def _shift(self, token: int, angle: float) -> tuple[float, float]:
        """From a token's centre of area to its centre of mass, as it lies."""
        x, y = self._centres[token].tolist()
        cos, sin = math.cos(angle), math.sin(angle)
        return cos * x - sin * y, sin * x + cos * y

    def _make_ground(self) -> int:
        box = self._call("createCollisionShape", pybullet.GEOM_BOX, halfExtents=(9.0, 9.0, 0.5))
        ground: int = self._call("createMultiBody", 0.0, box, basePosition=(0.0, 0.0, -0.5))
        self._call("changeDynamics", ground, -1, lateralFriction=1.0)  # the engine multiplies
        return ground

    def _make_token(self, token: int, friction: float) -> int:
        mesh = self._call("createCollisionShape", pybullet.GEOM_MESH, vertices=self._prisms[token])
        body: int = self._call(
            "createMultiBody",
            self._layout.shapes[token].area,
            mesh,
            baseInertialFramePosition=(*self._centres[token].tolist(), 0.0),
            useMaximalCoordinates=True,
        )
        self._call(
            "changeDynamics",
            body,
            -1,
            lateralFriction=friction,
            collisionMargin=_MARGIN,
            linearDamping=0.0,
            angularDamping=0.0,
        )
        return body

    def _make_finger(self, friction: float) -> int:
        """A cylinder on three joints: x, y and height."""
        cylinder = self._call(
            "createCollisionShape",
            pybullet.GEOM_CYLINDER,
            radius=self._finger,
            height=_HALF_HEIGHT,
        )
        three = range(3)
        finger: int = self._call(
            "createMultiBody",
            0.0,
            basePosition=(0.0, 0.0, _HALF_HEIGHT),
            linkMasses=[1.0 for _ in three],
            linkCollisionShapeIndices=[-1, -1, cylinder],
            linkVisualShapeIndices=[-1 for _ in three],
            linkPositions=[_NONE for _ in three],
            linkOrientations=[_UPRIGHT for _ in three],
            linkInertialFramePositions=[_NONE for _ in three],
            linkInertialFrameOrientations=[_UPRIGHT for _ in three],
            linkParentIndices=[0, 1, 2],
            linkJointTypes=[pybullet.JOINT_PRISMATIC for _ in three],
            linkJointAxis=[(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)],
        )
        self._call("changeDynamics", finger, 2, lateralFriction=friction)
        return finger
