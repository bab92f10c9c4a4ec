"""Tables with tokens as tensors, and the geometry of convex polygons.

Polygons have x and y first, then their corners: so one operation goes through all rows.
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

PUSHES = 1024  # random ones of each token, of which the best are looked for
_SEED = 0  # theirs: whoever plays and who learns have the same


@dataclass(frozen=True, eq=False)
class Scene:
    """What lies on n tables, and where it should come.

    Attributes:
        poses, goals: (n, K, 3) x, y and angle.
        which: (n, K) which tokens of the set these are.
        present: (n, K) of them that are on the table.
    """

    poses: Tensor
    goals: Tensor
    which: Tensor
    present: Tensor

    def repeated(self, count: int) -> "Scene":
        """Every row so many times."""
        return Scene(*(one.repeat_interleave(count, 0) for one in vars(self).values()))

    def only(self, rows: Tensor) -> "Scene":
        """These rows."""
        return Scene(*(one[rows] for one in vars(self).values()))


class Tokens:
    """What is the same on all tables.

    Attributes:
        count: K.
        outlines: (S, C, 2) in their own frames; the smaller ones repeat their last corner.
        corners: (2, C, S) the same.
        periods: (S,) turns that change nothing.
        begins, ends: (S, N, 2) of the finger, in the frames of the tokens.
        actions: (S, N, 4) these pushes, as the task takes them.
        within, turned: tolerances of a token that is in place.
        finger: its radius.
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
        """Of corners (n, V, 2): those on the table first."""
        there = on_table(goals, self._layout)
        which = np.argsort(~there, axis=1, kind="stable")[:, : self.count].copy()
        present = torch.from_numpy(np.take_along_axis(there, which, 1)).to(self._place)
        tokens = torch.from_numpy(which).to(self._place)
        return Scene(self.poses(corners, tokens), self.poses(goals, tokens), tokens, present)

    def poses(self, corners: Array, which: Tensor) -> Tensor:
        """(n, K, 3) of these tokens (n, K), of corners (n, V, 2)."""
        every = self._layout.poses(np.asarray(corners, np.float64)).astype(np.float32)
        poses = torch.from_numpy(every).to(self._place)
        return poses.gather(1, which[..., None].expand(-1, -1, 3))

    def placed(self, scene: Scene) -> Tensor:
        """(n, K) which tokens are in place."""
        left = self.left(scene.poses, scene.goals, scene.which)
        return self.near(left)

    def near(self, left: Tensor) -> Tensor:
        """(...) whether ways that are left (..., 3) are within the tolerance."""
        far: Tensor = left[..., :2].norm(dim=-1)
        return (far <= self.within) & (left[..., 2].abs() <= self.turned)

    def wrapped(self, angles: Tensor, which: Tensor) -> Tensor:
        """The least of turns (...) that come to the same."""
        period = self.periods[which]
        return angles - period * torch.round(angles / period)

    def left(self, poses: Tensor, goals: Tensor, which: Tensor) -> Tensor:
        """(..., 3) the way from poses to goals (..., 3), in the token's frame."""
        way = rotated(goals[..., :2] - poses[..., :2], -poses[..., 2])
        turn = self.wrapped(goals[..., 2] - poses[..., 2], which)
        return torch.cat([way, turn[..., None]], dim=-1)

    def after(self, left: Tensor, moved: Tensor, which: Tensor) -> Tensor:
        """(..., 3) what is left of ways where tokens move by (..., 3) in their own frames."""
        way = rotated(left[..., :2] - moved[..., :2], -moved[..., 2])
        turn = self.wrapped(left[..., 2] - moved[..., 2], which)
        return torch.cat([way, turn[..., None]], dim=-1)

    def laid(self, poses: Tensor, which: Tensor) -> Tensor:
        """(2, C, ...) outlines of tokens at poses (..., 3)."""
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
    """(..., 3) where tokens at poses come to that move by (..., 3) in their own frames."""
    way = rotated(moved[..., :2], poses[..., 2]) + poses[..., :2]
    return torch.cat([way, poses[..., 2:] + moved[..., 2:]], dim=-1)


def distance(outlines: Tensor, points: Tensor) -> Tensor:
    """(...) from points (2, ...) to convex polygons (2, C, ...); 0 inside."""
    edges, to = outlines.roll(-1, 1) - outlines, points[:, None] - outlines
    squares = _dot(edges, edges)
    share = (_dot(to, edges) / squares.clamp_min(1e-9)).clamp(0.0, 1.0)
    beside = to - share * edges
    apart = _dot(beside, beside).amin(0).sqrt()
    side = edges[0] * to[1] - edges[1] * to[0]
    inside = ((side >= 0.0) | (squares < 1e-9)).all(0)
    return torch.where(inside, 0.0, apart)


def gap(some: Tensor, others: Tensor) -> Tensor:
    """(...) between convex polygons (2, C, ...); where they overlap minus the depth.

    The largest distance along a normal of an edge (the separating axis theorem): where corner
    stands against corner, the true distance is more.
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
    """(...) of vectors (2, ...)."""
    return some[0] * others[0] + some[1] * others[1]
