"""Tokens on a table in PyBullet, and a finger that pushes them slowly.

A push is quasi-static: friction outweighs inertia, and a token moves only while it is pushed. The
friction of the table is an ellipsoid of force and moment: the limit surface of Goyal et al. 1991 in
the approximation of Lee and Cutkosky 1991. The engine gives the same motion for bodies that lose
their speed in every step, with these replacements: mass for the strength of the friction, inertia
for its moment, centre of mass for the centre of pressure. Coulomb friction in the engine, with
gravity, gives nearly the same result but needs steps a tenth as long.

Lengths are arena units, in which the table is 2 wide. Legend: K tokens.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from tangram_core.arrays import Bools, Floats
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.prisms import inset, prism
from tangram_sim.world.engine import Client, pybullet

# Half height of a collision shape: the shortest way out of another token is always sideways.
_WALL = 0.25
_MARGIN = 1e-3  # collision margin; shapes are smaller by this on every side
_STEP = 1.0 / 120.0  # distance that the finger moves in one step
_LEAST = 1e-6  # shortest distance worth a step
_ITERATIONS = 20  # of the engine's solver; the default is 50
_STIFF = 1e4  # inertia about x and y, so large that no token tips over
_FORCE = 1e4  # of the finger's motors, so large that no token slows it down
_ABOVE = 2.0  # height of the finger while it does not push
_TOKENS = 0.5  # friction of a token; the engine multiplies the coefficients of two bodies
_NONE, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Random physical parameters of an episode, hidden from agents.

    Attributes:
        table: (K,) coefficients of friction of table and token; only their ratios count.
        spread: (K,) squared lever of the friction, divided by the token's squared radius of
            gyration: .9 for uniform pressure, 2 or more if the corners carry the token.
        finger: coefficient of friction of finger and token.
        centres: (K, 2) from a token's centre of area to its centre of mass, in the body frame.
    """

    table: Floats
    spread: Floats
    finger: float
    centres: Floats


class PushTable(Client):
    """A table with tokens and a finger, in its own PyBullet client."""

    def __init__(self, layout: Layout, finger: float) -> None:
        """Make an empty table.

        Args:
            layout: the tokens.
            finger: radius of the finger.
        """
        self._layout, self._finger = layout, finger
        self._prisms = [prism(inset(shape.corners, _MARGIN), _WALL)[0] for shape in layout.shapes]
        self._gyration = [_gyration(shape.corners) for shape in layout.shapes]
        super().__init__()
        self._bodies: dict[int, int] = {}  # token -> body

    def place(self, poses: Floats, present: Bools, unknowns: Unknowns) -> None:
        """Lay the present tokens (K,) on an empty table, in poses (K, 3).

        All bodies are made again: the engine remembers contacts, and an episode must not depend on
        the one before.
        """
        self._call("resetSimulation")
        self._call(
            "setPhysicsEngineParameter",
            numSolverIterations=_ITERATIONS,
            deterministicOverlappingPairs=1,
        )
        self._pusher = self._make_finger(unknowns.finger / _TOKENS)
        self._centres = unknowns.centres
        self._bodies = {
            token: self._make_token(token, unknowns) for token in np.flatnonzero(present).tolist()
        }
        self.lay(poses)

    def lay(self, poses: Floats) -> None:
        """Move the tokens on the table to poses (K, 3); the engine still remembers contacts."""
        for token in self._bodies:
            self._put(token, poses[token])

    def push(self, begin: Floats, way: Floats) -> None:
        """Bring the finger down at `begin` (2,), move it by `way` (2,), not zero, and lift it."""
        for _ in self.follow(np.stack([begin, begin + way])):
            pass

    def follow(self, path: Floats) -> Iterator[int]:
        """Push along points (n, 2); yield the number of each point when the finger is there.

        A point closer than one step to the point before is left out, except the last point.
        """
        self._finger_at(path[0], 0.0)
        at, last = path[0], len(path) - 1
        for number, there in enumerate(path[1:], 1):
            way = there - at
            length = math.hypot(*way)
            if length < (_STEP if number < last else _LEAST):
                continue
            at = there
            steps = max(1, math.ceil(length / _STEP - 1e-6))
            # Set first: the force limit of a motor depends on the length of the step.
            self._call("setPhysicsEngineParameter", fixedTimeStep=length, numSubSteps=steps)
            self._call(  # one unit per second
                "setJointMotorControlArray",
                self._pusher,
                (0, 1, 2),
                pybullet.VELOCITY_CONTROL,
                targetVelocities=(way[0] / length, way[1] / length, 0.0),
                forces=(_FORCE, _FORCE, _FORCE),
            )
            self._call("stepSimulation")
            yield number
        self._finger_at(path[-1], _ABOVE)
        for token in self._bodies:
            self._put(token, self._pose(token))

    def poses(self) -> Floats:
        """Poses (K, 3) of the tokens: x, y and angle; zeros for tokens that are not present."""
        poses = np.zeros((self._layout.tokens, 3))
        for token in self._bodies:
            poses[token] = self._pose(token)
        return poses

    def _call(self, name: str, *given: Any, **named: Any) -> Any:
        return getattr(pybullet, name)(*given, **named, physicsClientId=self.client)

    def _finger_at(self, place: Floats, height: float) -> None:
        for joint, value in enumerate((*place.tolist(), height)):
            self._call("resetJointState", self._pusher, joint, value, 0.0)

    def _put(self, token: int, pose: Floats) -> None:
        """Lay a token down, at rest; the engine takes the position of its centre of mass."""
        x, y, angle = np.asarray(pose).tolist()
        right, up = self._shift(token, angle)
        place = (x + right, y + up, 0.0)
        turn = (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0))
        self._call("resetBasePositionAndOrientation", self._bodies[token], place, turn)
        self._call("resetBaseVelocity", self._bodies[token], _NONE, _NONE)

    def _pose(self, token: int) -> Floats:
        (x, y, _), (_, _, c, d) = self._call("getBasePositionAndOrientation", self._bodies[token])
        angle = 2.0 * (math.atan2(c, d) if d >= 0.0 else math.atan2(-c, -d))
        right, up = self._shift(token, angle)
        return np.array([x - right, y - up, angle])

    def _shift(self, token: int, angle: float) -> tuple[float, float]:
        """From a token's centre of area to its centre of mass, at its present angle."""
        x, y = self._centres[token].tolist()
        cos, sin = math.cos(angle), math.sin(angle)
        return cos * x - sin * y, sin * x + cos * y

    def _make_token(self, token: int, unknowns: Unknowns) -> int:
        mesh = self._call("createCollisionShape", pybullet.GEOM_MESH, vertices=self._prisms[token])
        strength = float(unknowns.table[token]) * self._layout.shapes[token].area
        body: int = self._call(
            "createMultiBody",
            strength,
            mesh,
            baseInertialFramePosition=(*self._centres[token].tolist(), 0.0),
            useMaximalCoordinates=True,
        )
        moment = strength * float(unknowns.spread[token] * self._gyration[token])
        self._call(
            "changeDynamics",
            body,
            -1,
            mass=strength,
            localInertiaDiagonal=(_STIFF, _STIFF, moment),
            lateralFriction=_TOKENS,
            collisionMargin=_MARGIN,
            linearDamping=1.0,
            angularDamping=1.0,
        )
        return body

    def _make_finger(self, friction: float) -> int:
        """Make the finger: a cylinder on three joints, for x, y and height."""
        cylinder = self._call(
            "createCollisionShape",
            pybullet.GEOM_CYLINDER,
            radius=self._finger,
            height=2.0 * _WALL,
        )
        three = range(3)
        finger: int = self._call(
            "createMultiBody",
            0.0,
            basePosition=_NONE,
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


def _gyration(corners: Floats) -> float:
    """Square of the radius of gyration of a polygon (V, 2) about its centre of area, the origin."""
    following = np.roll(corners, -1, axis=0)
    twice = corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]
    squares = (corners**2 + corners * following + following**2).sum(axis=1)
    return float((twice * squares).sum() / (6.0 * twice.sum()))
