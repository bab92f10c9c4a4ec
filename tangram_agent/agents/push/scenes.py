"""Tables with tokens as tensors, and the geometry of convex polygons.

The first axis of polygons is x and y, the second their corners: so operations go through all rows.
Legend: n rows, K tokens of a row, S tokens of the set, C corners of the largest, N pushes.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tangram_core.arrays import Floats
from tangram_core.spec import Array
from tangram_tasks.push.places import on_table, ways_of
from tangram_tasks.push.task import Push

PUSHES = 1024  # random pushes of each token, among which the best is chosen
_SEED = 0  # of the pushes: the same in workers and in the master


@dataclass(frozen=True, eq=False)
class Scene:
    """Tokens on n tables, and their goals.

    Attributes:
        poses, goals: (n, K, 3) x, y and angle.
        which: (n, K) indices of the tokens in the set.
        present: (n, K) whether each token is on the table.
    """

    poses: Tensor
    goals: Tensor
    which: Tensor
    present: Tensor

    def repeated(self, count: int) -> "Scene":
        """Each row repeated `count` times."""
        return Scene(*(one.repeat_interleave(count, 0) for one in vars(self).values()))

    def only(self, rows: Tensor) -> "Scene":
        """The scene of these rows."""
        return Scene(*(one[rows] for one in vars(self).values()))


class Tokens:
    """Shapes, pushes and tolerances of a set of tokens, the same for all tables.

    Attributes:
        count: K, number of tokens in a row.
        outlines: (S, C, 2) corners in the tokens' frames; the smaller ones repeat their last.
        corners: (2, C, S) the same corners with other axes.
        periods: (S,) smallest turns that leave the shapes as they are.
        begins, ends: (S, N, 2) first and last position of the finger, in the tokens' frames.
        actions: (S, N, 4) these pushes as actions of the task.
        within, turned: tolerances of position and angle of a token in place.
        finger: radius of the finger.
    """

    def __init__(self, task: Push, place: torch.device) -> None:
        layout, config = task.layout, task.config
        self._layout, self.count = layout, task.count
        self.within, self.turned, self.finger = config.within, config.turned, config.finger
        rng, each = np.random.default_rng(_SEED), np.arange(layout.tokens)
        self.actions = rng.uniform(-1.0, 1.0, (layout.tokens, PUSHES, 4))
        self.actions[..., 0] = ((each + 0.5) / layout.tokens * 2.0 - 1.0)[:, None]
        own = np.broadcast_to(layout.body, (layout.tokens * PUSHES, *layout.body.shape))
        flat = self.actions.reshape(-1, 4)
        _, begins, ways = ways_of(layout, own, flat, config.finger, config.longest)
        shape = (layout.tokens, PUSHES, 2)

        def tensor(array: Floats) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=place)

        self.begins, self.ends = (
            tensor(begins.reshape(shape)),
            tensor((begins + ways).reshape(shape)),
        )
        self.outlines = tensor(layout.body[layout.padded_corners])
        self.corners = self.outlines.permute(2, 1, 0).contiguous()
        self.periods = tensor(2.0 * np.pi / layout.symmetries)
        self._place = place

    def scene(self, corners: Array, goals: Array) -> Scene:
        """The scene of corners and goals (n, V, 2); tokens on the table come first."""
        there = on_table(goals, self._layout)
        which = np.argsort(~there, axis=1, kind="stable")[:, : self.count].copy()
        present = torch.from_numpy(np.take_along_axis(there, which, 1)).to(self._place)
        tokens = torch.from_numpy(which).to(self._place)
        return Scene(self.poses(corners, tokens), self.poses(goals, tokens), tokens, present)

    def poses(self, corners: Array, which: Tensor) -> Tensor:
        """Poses (n, K, 3) of the tokens `which` (n, K), from corners (n, V, 2)."""
        every = self._layout.poses(np.asarray(corners, np.float64)).astype(np.float32)
        poses = torch.from_numpy(every).to(self._place)
        return poses.gather(1, which[..., None].expand(-1, -1, 3))

    def placed(self, scene: Scene) -> Tensor:
        """(n, K) whether each token is in place."""
        left = self.left(scene.poses, scene.goals, scene.which)
        return self.near(left)

    def near(self, left: Tensor) -> Tensor:
        """(...) whether remaining ways (..., 3) are within the tolerances."""
        far: Tensor = left[..., :2].norm(dim=-1)
        return (far <= self.within) & (left[..., 2].abs() <= self.turned)

    def wrapped(self, angles: Tensor, which: Tensor) -> Tensor:
        """The smallest turns (...) after which tokens look as after the given angles."""
        period = self.periods[which]
        return angles - period * torch.round(angles / period)

    def left(self, poses: Tensor, goals: Tensor, which: Tensor) -> Tensor:
        """Remaining ways (..., 3) from poses to goals (..., 3), in the tokens' frames."""
        way = rotated(goals[..., :2] - poses[..., :2], -poses[..., 2])
        turn = self.wrapped(goals[..., 2] - poses[..., 2], which)
        return torch.cat([way, turn[..., None]], dim=-1)

    def after(self, left: Tensor, moved: Tensor, which: Tensor) -> Tensor:
        """Remaining ways (..., 3) after tokens move by (..., 3) in their own frames."""
        return self.left(moved, left, which)

    def laid(self, poses: Tensor, which: Tensor) -> Tensor:
        """Outlines (2, C, ...) of tokens at poses (..., 3)."""
        cos, sin = torch.cos(poses[..., 2]), torch.sin(poses[..., 2])
        x, y = self.corners[:, :, which]
        laid = cos * x - sin * y + poses[..., 0], sin * x + cos * y + poses[..., 1]
        return torch.stack(laid)


def rotated(vectors: Tensor, angles: Tensor) -> Tensor:
    """Vectors (..., 2) turned by angles (...)."""
    cos, sin = torch.cos(angles), torch.sin(angles)
    x, y = vectors.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def placed_at(poses: Tensor, moved: Tensor) -> Tensor:
    """Poses (..., 3) of tokens after they move by (..., 3) in their own frames."""
    way = rotated(moved[..., :2], poses[..., 2]) + poses[..., :2]
    return torch.cat([way, poses[..., 2:] + moved[..., 2:]], dim=-1)


def distance(outlines: Tensor, points: Tensor) -> Tensor:
    """Distances (...) from points (2, ...) to convex polygons (2, C, ...); 0 inside."""
    edges, to = outlines.roll(-1, 1) - outlines, points[:, None] - outlines
    squares = _dot(edges, edges)
    share = (_dot(to, edges) / squares.clamp_min(1e-9)).clamp(0.0, 1.0)
    beside = to - share * edges
    apart = _dot(beside, beside).amin(0).sqrt()
    side = edges[0] * to[1] - edges[1] * to[0]
    inside = ((side >= 0.0) | (squares < 1e-9)).all(0)
    return torch.where(inside, 0.0, apart)


def gap(some: Tensor, others: Tensor) -> Tensor:
    """Gaps (...) between convex polygons (2, C, ...); minus the depth where they overlap.

    The largest distance along a normal of an edge (the separating axis theorem). Between two
    corners the true distance is larger.
    """
    found = []
    for one, other in ((some, others), (others, some)):
        edges = one.roll(-1, 1) - one
        lengths = _dot(edges, edges).sqrt()
        normals = torch.stack([edges[1], -edges[0]]) / lengths.clamp_min(1e-6)
        nearest = _dot(normals[:, :, None], other[:, None]).amin(1)
        apart = torch.where(lengths < 1e-6, -torch.inf, nearest - _dot(normals, one))
        found.append(apart.amax(0))
    return torch.maximum(*found)


def _dot(some: Tensor, others: Tensor) -> Tensor:
    """Dot products (...) of vectors (2, ...)."""
    return some[0] * others[0] + some[1] * others[1]
