"""What pushes do to a token that lies alone, and how many it then needs.

Random pushes of each shape are tried in an engine, at the middle of what is unknown. From these
value iteration computes how many are needed, on a grid that is fine where little is left to go.

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

PUSHES, FEW = 1024, 512  # of each shape; and those of them that value iteration chooses from
GRID, FAR, SWEEPS = (21, 21, 17), 2.9, 12  # x, y and turn that are left; the most of x and y


@dataclass(frozen=True, eq=False)
class Pushes:
    """What random pushes do to a shape that lies alone.

    Attributes:
        actions: (N, 3) where, turn, far.
        moved: (N, 3) x, y and turn of the token in its own frame.
        begins, ends: (N, 2) of the finger, there.
    """

    actions: Floats
    moved: Floats
    begins: Floats
    ends: Floats


def way_left(poses: AnyArray, desired: AnyArray) -> Floats:
    """(..., 3) from poses (..., 3) to others, in the frames of the first."""
    way = (desired[..., :2] - poses[..., :2]) @ (1.0, 1j) * np.exp(-1j * poses[..., 2])
    return np.stack([way.real, way.imag, desired[..., 2] - poses[..., 2]], axis=-1)


def after(ways: AnyArray, moved: AnyArray) -> Floats:
    """(..., 3) ways that are left, in the frames of tokens that moved by (..., 3) in theirs."""
    return way_left(moved, ways)


def moved_by(poses: Floats, moved: Floats) -> Floats:
    """(..., 3) poses after tokens moved by (..., 3) in their own frames."""
    way = moved[..., :2] @ (1.0, 1j) * np.exp(1j * poses[..., 2])
    there: Floats = poses + np.stack([way.real, way.imag, moved[..., 2]], axis=-1)
    return there


class Left:
    """How many pushes a token that lies alone needs."""

    def __init__(
        self, pushes: Pushes, period: float, within: float, turned: float, margin: float
    ) -> None:
        """Iterate; some seconds.

        Args:
            pushes: to choose from.
            period: turn that comes to the same.
            within, turned: tolerances of a token that is in place.
            margin: cost of one that is as far away as it may be: friction may add to it.
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
        """(...) of ways that are left (..., 3); in place below 1, the less the nearer."""
        return np.where(self.near(ways), self._off(ways), self._looked_up(self._at(ways)))

    def near(self, ways: Floats) -> Bools:
        """(...) whether nothing is left."""
        far, turn = np.hypot(ways[..., 0], ways[..., 1]), np.abs(self._wrapped(ways[..., 2]))
        return np.asarray((far <= self._scale[0]) & (turn <= self._scale[2]))

    def _off(self, ways: Floats) -> Floats:
        """(...) cost of tokens in place that are not quite where they should be."""
        parts = ways[..., 0], ways[..., 1], self._wrapped(ways[..., 2])
        found: Floats = np.linalg.norm(np.stack(parts, axis=-1) / self._scale, axis=-1)
        return self._margin * found

    def _wrapped(self, turns: Floats) -> Floats:
        least: Floats = turns - self._period * np.round(turns / self._period)
        return least

    def _at(self, ways: Floats) -> Floats:
        """(3, ...) where they lie on the grid."""
        parts = ways[..., 0], ways[..., 1], self._wrapped(ways[..., 2])
        each = zip(parts, self._scale, self._most, GRID, strict=True)
        rows = [
            (np.arcsinh(way / unit) / most + 1.0) / 2.0 * (n - 1) for way, unit, most, n in each
        ]
        return np.stack(rows)

    def _looked_up(self, at: Floats) -> Floats:
        """(...) between the points of the grid; one push at least."""
        found: Floats = map_coordinates(self._counts, at, order=1, mode="nearest")
        return np.maximum(found, 1.0)


@lru_cache(maxsize=64)
def tried_alone(
    shape: Shape, known: tuple[float, float], finger: float, longest: float, *within: float
) -> tuple[Pushes, Left]:
    """Random pushes of a shape, and how many it needs; some seconds when it is asked for first.

    Args:
        shape: of the token.
        known: the finger's friction, and the squared lever of the table's.
        finger: its radius.
        longest: way of the longest push.
        *within: tolerances of a token that is in place, of distance and turn, and the margin.
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
