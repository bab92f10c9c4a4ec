"""Effects of random pushes on a token that lies alone, and how many pushes such a token needs.

Random pushes of each shape are simulated, with hidden parameters at the middle of their ranges.
Value iteration then computes how many pushes are needed, on a grid that is finest near the goal.

Legend: N pushes of a shape, G points of the grid, n rows.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates

from tangram_core.arrays import AnyArray, Bools, Floats
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.shapes import Shape
from tangram_sim.world.pushing import PushTable, Unknowns
from tangram_tasks.push.places import push_of

PUSHES, FEW = 1024, 512  # random pushes of each shape; the first of them, for value iteration
GRID, FAR, SWEEPS = (21, 21, 17), 2.9, 12  # points in x, y and turn; largest x and y; sweeps


@dataclass(frozen=True, eq=False)
class Pushes:
    """Random pushes of a shape that lies alone, and their effects.

    Attributes:
        actions: (N, 3) place on the edge, direction and length, in [-1, 1]; see `ways_of`.
        moved: (N, 3) x, y and turn by which the token moved, in its own frame.
        begins, ends: (N, 2) points of the finger, in the same frame.
    """

    actions: Floats
    moved: Floats
    begins: Floats
    ends: Floats


def way_left(poses: AnyArray, desired: AnyArray) -> Floats:
    """Remaining ways (..., 3) from poses (..., 3) to desired ones, in the frames of the poses."""
    way = (desired[..., :2] - poses[..., :2]) @ (1.0, 1j) * np.exp(-1j * poses[..., 2])
    return np.stack([way.real, way.imag, desired[..., 2] - poses[..., 2]], axis=-1)


def after(ways: AnyArray, moved: AnyArray) -> Floats:
    """Remaining ways (..., 3) after motions (..., 3), all in the tokens' own frames."""
    return way_left(moved, ways)


def moved_by(poses: Floats, moved: Floats) -> Floats:
    """Poses (..., 3) after tokens moved by (..., 3) in their own frames."""
    way = moved[..., :2] @ (1.0, 1j) * np.exp(1j * poses[..., 2])
    there: Floats = poses + np.stack([way.real, way.imag, moved[..., 2]], axis=-1)
    return there


class Left:
    """Number of pushes that a token needs if it lies alone, by value iteration."""

    def __init__(
        self, pushes: Pushes, period: float, within: float, turned: float, margin: float
    ) -> None:
        """Run value iteration, which takes some seconds.

        Args:
            pushes: the pushes to choose from.
            period: turn after which the shape looks the same, in radians.
            within, turned: tolerances of distance and turn of a token in place.
            margin: cost of a token just within tolerance: other friction may leave it outside.
        """
        self._period, self._margin, self._scale = period, margin, np.array([within, within, turned])
        self._most = np.arcsinh([FAR, FAR, period / 2.0] / self._scale)
        axes = [np.linspace(-1.0, 1.0, size) for size in GRID]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * self._most
        ways = self._scale * np.sinh(points)
        then = after(ways[:, None], pushes.moved[None, :FEW])
        at, near, off = self._at(then), self.near(then), self._off(then)
        self._counts = 1.0 + np.linalg.norm(points, axis=1).reshape(GRID)
        for _ in range(SWEEPS):
            found = np.where(near, off, self._looked_up(at))
            self._counts = 1.0 + found.min(axis=1).reshape(GRID)

    def __call__(self, ways: Floats) -> Floats:
        """Number of pushes (...) for remaining ways (..., 3); below 1 if in place."""
        return np.where(self.near(ways), self._off(ways), self._looked_up(self._at(ways)))

    def near(self, ways: Floats) -> Bools:
        """(...) whether tokens with these remaining ways (..., 3) are in place."""
        far, turn = np.hypot(ways[..., 0], ways[..., 1]), np.abs(self._wrapped(ways[..., 2]))
        return np.asarray((far <= self._scale[0]) & (turn <= self._scale[2]))

    def _off(self, ways: Floats) -> Floats:
        """(...) cost of the remaining errors of tokens in place."""
        parts = ways[..., 0], ways[..., 1], self._wrapped(ways[..., 2])
        found: Floats = np.linalg.norm(np.stack(parts, axis=-1) / self._scale, axis=-1)
        return self._margin * found

    def _wrapped(self, turns: Floats) -> Floats:
        least: Floats = turns - self._period * np.round(turns / self._period)
        return least

    def _at(self, ways: Floats) -> Floats:
        """Coordinates (3, ...) of ways (..., 3) on the grid."""
        parts = ways[..., 0], ways[..., 1], self._wrapped(ways[..., 2])
        each = zip(parts, self._scale, self._most, GRID, strict=True)
        rows = [
            (np.arcsinh(way / unit) / most + 1.0) / 2.0 * (n - 1) for way, unit, most, n in each
        ]
        return np.stack(rows)

    def _looked_up(self, at: Floats) -> Floats:
        """(...) numbers of pushes interpolated on the grid; at least 1."""
        found: Floats = map_coordinates(self._counts, at, order=1, mode="nearest")
        return np.maximum(found, 1.0)


@lru_cache(maxsize=64)
def tried_alone(
    shape: Shape, known: tuple[float, float], finger: float, longest: float, *within: float
) -> tuple[Pushes, Left]:
    """Random pushes of a shape, and the number that it needs; the first call takes seconds.

    Args:
        shape: shape of the token.
        known: friction coefficient of the finger, and squared lever of the table's friction.
        finger: radius of the finger.
        longest: length of the longest push.
        *within: tolerances of distance and turn, and the margin, as in `Left`.
    """
    layout, rng = Layout([shape]), np.random.default_rng(0)
    table, present = PushTable(layout, finger), np.ones(1, np.bool_)
    unknowns = Unknowns(np.ones(1), np.full(1, known[1]), known[0], np.zeros((1, 2)))
    table.place(np.zeros((1, 3)), present, unknowns)
    actions, moved = rng.uniform(-1.0, 1.0, (PUSHES, 3)), np.zeros((PUSHES, 3))
    begins, ends = np.zeros((2, PUSHES, 2))
    corners = layout.corners(np.zeros((1, 3)))
    for i, action in enumerate(actions):
        push = push_of(layout, corners, np.append(0.0, action), finger, longest)
        table.lay(np.zeros((1, 3)))
        table.push(push.begin, push.way)
        moved[i], begins[i], ends[i] = table.poses()[0], push.begin, push.begin + push.way
    table.close()
    pushes = Pushes(actions, moved, begins, ends)
    return pushes, Left(pushes, 2.0 * np.pi / float(layout.symmetries[0]), *within)
