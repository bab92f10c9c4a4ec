"""Tokens on a table in PyBullet, and a finger that pushes them slowly.

A push is quasi-static: friction is much more than inertia, and a token moves as far as something
pushes it. The table's friction resists like an ellipsoid of force and moment (the limit surface of
Goyal et al. 1991 as Lee and Cutkosky 1991 approximate it): then what moves, and how, is what the
engine makes of contacts between bodies that forget their speed in every step, whose mass is the
friction's strength, whose inertia is its moment, and whose centre of mass is the centre of
pressure. Coulomb friction in the engine itself, with gravity, comes to nearly the same and needs
steps a tenth as long.

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

# Of a token as it collides: so tall that the shortest way out of another is always sideways.
_WALL = 0.25
_MARGIN = 1e-3  # of what collides, which is smaller by it on every side
_STEP = 1.0 / 120.0  # way of the finger in one step
_LEAST = 1e-6  # way that is worth a step
_ITERATIONS = 20  # of the engine's solver; 50 are its default
_STIFF = 1e4  # inertia about x and y, far more than a token's: none tips over
_FORCE = 1e4  # of the finger's motors: nothing that is pushed slows it down
_ABOVE = 2.0  # height of the finger while it does not push
_TOKENS = 0.5  # coefficient of a token, which the engine multiplies with the other's
_NONE, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What is drawn for an episode, and told to nobody.

    Attributes:
        table: (K,) coefficients of friction of table and token; only their ratios count.
        spread: (K,) square of the friction's lever, in squares of the token's radius of gyration:
            .9 where it is pressed alike everywhere, 2 and more where its corners carry it.
        finger: coefficient of friction of finger and token.
        centres: (K, 2) from each token's centre of area to its centre of mass, in its own frame.
    """

    table: Floats
    spread: Floats
    finger: float
    centres: Floats


class PushTable(Client):
    """Bodies in one PyBullet client of their own, in DIRECT mode."""

    def __init__(self, layout: Layout, finger: float) -> None:
        """Make an empty table.

        Args:
            layout: the tokens.
            finger: its radius.
        """
        self._layout, self._finger = layout, finger
        self._prisms = [prism(inset(shape.corners, _MARGIN), _WALL)[0] for shape in layout.shapes]
        self._gyration = [_gyration(shape.corners) for shape in layout.shapes]
        super().__init__()
        self._bodies: dict[int, int] = {}  # token -> body

    def place(self, poses: Floats, present: Bools, unknowns: Unknowns) -> None:
        """Lay the tokens (K, 3) that are present on an empty table.

        All is made anew: the engine keeps something of every contact, and an episode must not hang
        on the one before it.
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
        """Move the tokens on the table to poses (K, 3); the engine keeps what it kept."""
        for token in self._bodies:
            self._put(token, poses[token])

    def push(self, begin: Floats, way: Floats) -> None:
        """Bring the finger down at `begin` (2,), move it by `way` (2,), not none, and lift it."""
        for _ in self.follow(np.stack([begin, begin + way])):
            pass

    def follow(self, path: Floats) -> Iterator[int]:
        """The same along points (n, 2), step by step; yields the number of one where it is there.

        Points within a step of the one before are left out, but for the last.
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
            # First: what a motor can do hangs on the step's length.
            self._call("setPhysicsEngineParameter", fixedTimeStep=length, numSubSteps=steps)
            self._call(  # a unit in a second
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
        """(K, 3) x, y and angle of every token; zeros of those that are away."""
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
        """Lay a token down, at rest; the engine asks where its centre of mass is."""
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
        """From a token's centre of area to its centre of mass, as it lies."""
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
        """A cylinder on three joints: x, y and height."""
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
