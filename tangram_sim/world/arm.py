"""A robot's arm with a peg: PyBullet's Franka Panda, in a client without tokens.

The peg follows the finger's path within the limits of the joints' angles, speeds and forces. Forces
of tokens on the peg are left out, since they are small beside those of the arm's motors.

Lengths are metres, the table's middle is the origin, z is up. Legend: N moments.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tangram_core.arrays import Floats
from tangram_sim.world.engine import Client, pybullet

METRES = 0.2  # length of an arena unit: the arm reaches all of a table 0.4 m wide
LIFTED, LOWERED = 0.06, 0.008  # heights of the peg's tip
BASE = (-0.5, 0.0, 0.0)
_PEG = 0.1  # from the gripper's grasp point down to the tip
_JOINTS, _GRASP = tuple(range(7)), 11
HOME = (0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785)
_DOWN = (1.0, 0.0, 0.0, 0.0)  # the gripper's orientation
_STEP = 1.0 / 240.0  # seconds
_SOLVES, _CLOSE = 40, 1e-6  # iterations and residual of the inverse kinematics
_OFF = 0.002  # largest error of the tip; with more a push has failed
_SPEEDS = {"travel": 0.3, "down": 0.15, "push": 0.1, "up": 0.15}  # highest, metres per second


@dataclass(frozen=True, eq=False)
class Motion:
    """A recorded motion of an arm.

    Attributes:
        seconds: (N,) since the motion began.
        tips: (N, 3) positions of the peg's tip.
        joints: (N, 7) angles of the joints.
        parts: (N,) part of the motion: travel, down, push or up.
    """

    seconds: Floats
    tips: Floats
    joints: Floats
    parts: tuple[str, ...]

    @property
    def pushed(self) -> Floats:
        """Path (n, 2) of the tip while it pushed."""
        return self.tips[[part == "push" for part in self.parts], :2]


def way_points(begin: Floats, way: Floats) -> list[tuple[str, Floats]]:
    """Parts of a push from `begin` (2,) by `way` (2,), each with the tip's end point (3,)."""
    end = begin + way
    places = (begin, LIFTED), (begin, LOWERED), (end, LOWERED), (end, LIFTED)
    return [(name, np.array([*at, z])) for name, (at, z) in zip(_SPEEDS, places, strict=True)]


def duration(part: str, length: float) -> float:
    """Seconds that a part of a push takes over a length in metres, from rest to rest."""
    return 1.5 * length / _SPEEDS[part]  # the highest speed is 1.5 times the mean


class Panda(Client):
    """A simulated Franka Panda arm at the left side of the table."""

    def __init__(self) -> None:
        """Load the arm, with its tip above the table's middle."""
        import pybullet_data  # noqa: PLC0415 - comes with pybullet, slow to import

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
        """Put the arm at its first position, at rest."""
        self.at(HOME)
        self.at(self._solved(np.array([0.0, 0.0, LIFTED])))

    def at(self, joints: Sequence[float]) -> None:
        """Put the joints at angles (7,), at rest."""
        for joint, angle in zip(_JOINTS, joints, strict=True):
            pybullet.resetJointState(self.body, joint, angle, physicsClientId=self.client)

    def push(self, begin: Floats, way: Floats) -> Motion | None:
        """Travel to `begin` (2,), come down, push by `way` (2,), and lift.

        Returns:
            The motion; None if the tip left its path, or a joint exceeded its angles or speed.
        """
        here, seconds, found = self._tip(), 0.0, list[tuple[float, Floats, Floats, str]]()
        for part, there in way_points(begin, way):
            length = float(np.linalg.norm(there - here))
            count = max(1, round(duration(part, length) / _STEP))
            for step in range(1, count + 1):
                share = step / count
                share *= share * (3.0 - 2.0 * share)  # smooth, from rest to rest
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
        """Angles and speeds (7,) of the joints after a step towards `aim`."""
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
        """Angles of the joints for a tip (3,), found from the present angles."""
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
