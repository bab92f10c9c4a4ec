"""A robot's arm with a peg: the Franka Panda that comes with PyBullet, in a client of its own.

It goes where a finger would, as joints that have limits, speeds and forces allow. What tokens do
against its peg is small beside its motors and is left out: they follow the peg, not the peg them.

Lengths are metres, the table's middle is the origin, z is up. Legend: N moments, W way points.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tangram_core.arrays import Floats
from tangram_sim.world.engine import Client, pybullet

METRES = 0.2  # of an arena unit: a table 0.4 m wide lies where the arm reaches all of it
LIFTED, LOWERED = 0.06, 0.008  # heights of the peg's tip
BASE = (-0.5, 0.0, 0.0)
_PEG = 0.1  # from between the gripper's fingers down to the tip
_JOINTS, _GRASP = tuple(range(7)), 11
HOME = (0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785)
_DOWN = (1.0, 0.0, 0.0, 0.0)  # the gripper's orientation
_STEP = 1.0 / 240.0  # seconds
_SOLVES, _CLOSE = 40, 1e-6  # of the inverse kinematics, from where the joints are
_OFF = 0.002  # of the tip from where it should be: more, and it does not get there
_SPEEDS = {"travel": 0.3, "down": 0.15, "push": 0.1, "up": 0.15}  # metres a second, at most


@dataclass(frozen=True, eq=False)
class Motion:
    """What an arm did.

    Attributes:
        seconds: (N,) from the motion's beginning.
        tips: (N, 3) where the peg's tip was.
        joints: (N, 7) angles.
        parts: (N,) which of travel, down, push and up it was.
    """

    seconds: Floats
    tips: Floats
    joints: Floats
    parts: tuple[str, ...]

    @property
    def pushed(self) -> Floats:
        """(n, 2) the way of the tip while it pushed."""
        return self.tips[[part == "push" for part in self.parts], :2]


def way_points(begin: Floats, way: Floats) -> list[tuple[str, Floats]]:
    """Where a tip goes to push from `begin` (2,) by `way` (2,): parts and their ends (3,)."""
    end = begin + way
    places = (begin, LIFTED), (begin, LOWERED), (end, LOWERED), (end, LIFTED)
    return [(name, np.array([*at, z])) for name, (at, z) in zip(_SPEEDS, places, strict=True)]


def duration(part: str, length: float) -> float:
    """Seconds of a part of so many metres, from rest to rest: half as fast again in the middle."""
    return 1.5 * length / _SPEEDS[part]


class Panda(Client):
    """An arm at the table's left side."""

    def __init__(self) -> None:
        """Set it up, above the table's middle."""
        import pybullet_data  # noqa: PLC0415 - comes with pybullet, and takes its time

        super().__init__()
        model = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
        one = {"physicsClientId": self.client}
        self.body: int = pybullet.loadURDF(str(model), BASE, useFixedBase=True, **one)
        pybullet.setTimeStep(_STEP, **one)
        pybullet.setGravity(0.0, 0.0, -9.81, **one)
        facts = [pybullet.getJointInfo(self.body, joint, **one) for joint in _JOINTS]
        self.low, self.high, self._force, self.fastest = np.array([fact[8:12] for fact in facts]).T
        self.home()

    def home(self) -> None:
        """Back to where it begins, at rest."""
        self.at(HOME)
        self.at(self._solved(np.array([0.0, 0.0, LIFTED])))

    def at(self, joints: Sequence[float]) -> None:
        """Put the joints (7,) at angles, at rest."""
        for joint, angle in zip(_JOINTS, joints, strict=True):
            pybullet.resetJointState(self.body, joint, angle, physicsClientId=self.client)

    def push(self, begin: Floats, way: Floats) -> Motion | None:
        """Travel to `begin` (2,), come down, push by `way` (2,), and lift.

        Returns:
            What it did; None where its tip, a joint's angle or a joint's speed went astray.
        """
        here, seconds, found = self._tip(), 0.0, list[tuple[float, Floats, Floats, str]]()
        for part, there in way_points(begin, way):
            length = float(np.linalg.norm(there - here))
            count = max(1, round(duration(part, length) / _STEP))
            for step in range(1, count + 1):
                share = step / count
                share *= share * (3.0 - 2.0 * share)  # from rest to rest
                aim = here + share * (there - here)
                joints, speeds = self._moved(aim)
                seconds += _STEP
                tip = self._tip()
                if self._astray(joints, speeds) or np.linalg.norm(tip - aim) > _OFF:
                    self.home()
                    return None
                found.append((seconds, tip, joints, part))
            here = there
        times, tips, angles, parts = zip(*found, strict=True)
        return Motion(np.array(times), np.array(tips), np.array(angles), parts)

    def _moved(self, aim: Floats) -> tuple[Floats, Floats]:
        """Joints' angles and speeds (7,), a step later."""
        pybullet.setJointMotorControlArray(
            self.body,
            _JOINTS,
            pybullet.POSITION_CONTROL,
            targetPositions=self._angles(aim),
            forces=self._force.tolist(),
            positionGains=[1.0 for _ in _JOINTS],
            velocityGains=[1.0 for _ in _JOINTS],
            physicsClientId=self.client,
        )
        pybullet.stepSimulation(physicsClientId=self.client)
        states = pybullet.getJointStates(self.body, _JOINTS, physicsClientId=self.client)
        return np.array([one[0] for one in states]), np.array([one[1] for one in states])

    def _astray(self, joints: Floats, speeds: Floats) -> bool:
        beyond = (joints < self.low) | (joints > self.high) | (np.abs(speeds) > self.fastest)
        return bool(beyond.any())

    def _tip(self) -> Floats:
        state = pybullet.getLinkState(
            self.body, _GRASP, computeForwardKinematics=True, physicsClientId=self.client
        )
        return np.array(state[4]) - (0.0, 0.0, _PEG)

    def _angles(self, tip: Floats) -> list[float]:
        """Of the joints, near where they are, for a tip (3,)."""
        x, y, z = tip.tolist()
        found = pybullet.calculateInverseKinematics(
            self.body,
            _GRASP,
            (x, y, z + _PEG),
            _DOWN,
            maxNumIterations=_SOLVES,
            residualThreshold=_CLOSE,
            physicsClientId=self.client,
        )
        return list(found[: len(_JOINTS)])

    def _solved(self, tip: Floats) -> list[float]:
        angles = list(HOME)
        for _ in range(10):
            angles = self._angles(tip)
            self.at(angles)
        return angles
