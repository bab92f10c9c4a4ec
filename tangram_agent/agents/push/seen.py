"""Network inputs for tokens and pushes, in the frame of the token that is pushed.

Networks see one other token, the one that matters most. Of all others they see only how near a push
comes to them. So what they learn with two tokens also holds for seven.

Legend: n rows, each with a token that may be pushed; K tokens of a row, C corners, N pushes.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tangram_agent.agents.push.scenes import (
    Scene,
    Tokens,
    distance,
    gap,
    placed_at,
    rotated,
)
from tangram_agent.nets.graph import unit
from tangram_tasks.push.places import ARENA

LEFT = 9  # features of a remaining way
PUSH = 5 + LEFT + 8  # features of a push: motion, table's edge, remaining way, other tokens
_LARGE = 3.0  # factor that scales a token's corners to about 1
_NEAR = 0.1  # larger gaps count as this
_EDGE = 0.3  # larger distances from the table's edge count as this


def token_numbers(corners: int) -> int:
    """Number of features of the pushed token: way, outline, distance from the table's edge."""
    return LEFT + 2 * corners + 1


def other_numbers(corners: int) -> int:
    """Number of features of another token: way, outline, pose, corners and goal."""
    return LEFT + 2 * corners + 4 + 2 * corners + 4


@dataclass(frozen=True, eq=False)
class Seen:
    """Network inputs of n pushed tokens, and what pushes need to know of the other tokens.

    Attributes:
        token: (n, F) features of the pushed token.
        other: (n, G) features of the other token that matters most.
        there: (n, 1) 1 where there is such an other token.
        pose, left: (n, 3) pose of the pushed token, and its remaining way in its own frame.
        which: (n,) index of the pushed token in the set.
        outlines: (2, C, n, K - 1) outlines of all others, on the table.
        placed: (n, K - 1) whether each of the others is in place.
    """

    token: Tensor
    other: Tensor
    there: Tensor
    pose: Tensor
    left: Tensor
    which: Tensor
    outlines: Tensor
    placed: Tensor


def beside(scene: Scene, slots: Tensor) -> Tensor:
    """For each token in `slots` (n,), the slot of the other one nearest to it or to its goal.

    Without another token on the table: an absent token, or the token itself.
    """
    rows = torch.arange(len(slots), device=slots.device)
    here, goal = (of[rows, slots, None, :2] for of in (scene.poses, scene.goals))
    there = scene.poses[..., :2]
    far = torch.minimum((there - here).norm(dim=-1), (there - goal).norm(dim=-1))
    own = torch.arange(far.shape[1], device=slots.device) == slots[:, None]
    return torch.where(own | ~scene.present, torch.inf, far).argmin(1)


def seen_by(tokens: Tokens, scene: Scene, slots: Tensor, others: Tensor) -> Seen:
    """Inputs for the tokens in `slots` (n,), with those in the slots `others` (n,) beside them."""
    rows, count = torch.arange(len(slots), device=slots.device), scene.poses.shape[1]
    left = tokens.left(scene.poses, scene.goals, scene.which)
    pose, which, own = scene.poses[rows, slots], scene.which[rows, slots], left[rows, slots]
    token = [ways(tokens, own), tokens.outlines[which].flatten(1) * _LARGE, edge(pose[:, :2])]
    x, y, cos, sin = *pose[:, :2].T, pose[:, 2].cos(), pose[:, 2].sin()

    def here(points: Tensor) -> Tensor:  # (..., n, 2) in the token's frame, of (2, ..., n)
        right, up = points[0] - x, points[1] - y
        return torch.stack([cos * right + sin * up, cos * up - sin * right], dim=-1)

    at = rows, others
    poses, goals, kinds = scene.poses[at], scene.goals[at], scene.which[at]
    other = [
        ways(tokens, left[at]),
        tokens.outlines[kinds].flatten(1) * _LARGE,
        here(poses.T),
        unit(poses[:, 2] - pose[:, 2]),
        here(tokens.laid(poses, kinds)).movedim(0, 1).flatten(1),
        here(goals.T),
        unit(goals[:, 2] - pose[:, 2]),
    ]
    there = (scene.present[at] & (others != slots)).to(pose.dtype)[:, None]
    each = (slots[:, None] + torch.arange(1, count, device=slots.device)) % count
    every = rows[:, None], each
    outlines = tokens.laid(scene.poses[every], scene.which[every])
    seen = torch.cat(token, dim=-1), torch.cat(other, dim=-1), there
    return Seen(*seen, pose, own, which, outlines, tokens.near(left[every]))


def ways(tokens: Tokens, left: Tensor) -> Tensor:
    """Features (..., 9) of remaining ways (..., 3): raw, scaled, log lengths, whether in place."""
    far, turn = left[..., :2].norm(dim=-1, keepdim=True), left[..., 2:].abs()
    place = (left[..., :2] / (6.0 * tokens.within)).clamp(-1.5, 1.5)
    angle = (left[..., 2:] / (6.0 * tokens.turned)).clamp(-1.5, 1.5)
    in_place = tokens.near(left)[..., None].to(left.dtype)
    logs = torch.log(far + 0.01) + 2.0, torch.log(turn + 0.03) + 1.0
    return torch.cat([left, place, angle, *logs, in_place], dim=-1)


def edge(points: Tensor) -> Tensor:
    """Distances (..., 1) of points (..., 2) from the table's edge: -1 at it, 1 from `_EDGE` on."""
    room = ARENA / 2.0 - points.abs().amax(-1, keepdim=True)
    return (room.clamp(0.0, _EDGE) / _EDGE - 0.5) * 2.0


def pushes(
    tokens: Tokens, seen: Seen, begins: Tensor, ends: Tensor, moved: Tensor
) -> tuple[Tensor, Tensor]:
    """Features (n, N, 22) of pushes, and whether each push is impossible (n, N).

    Args:
        tokens: the set of tokens.
        seen: the pushed tokens.
        begins: (n, N, 2) where the finger comes down, in the token's frame.
        ends: (n, N, 2) where the finger stops, in the token's frame.
        moved: (n, N, 3) how the token would move if it were alone.
    """
    pose = seen.pose[:, None].expand(*moved.shape)
    first, last = (rotated(at, pose[..., 2]) + pose[..., :2] for at in (begins, ends))
    limit = ARENA / 2.0 - tokens.finger
    beyond = (torch.maximum(first.abs(), last.abs()) > limit).any(-1)
    left = tokens.after(seen.left[:, None], moved, seen.which[:, None])
    parts = [moved * 3.0, edge(first), edge(last), ways(tokens, left)]
    others = seen.outlines[:, :, :, None]
    if not others.shape[-1]:
        parts.append(torch.ones_like(moved[..., :1]).expand(*moved.shape[:2], 8))
        return torch.cat(parts, dim=-1), beyond
    which = seen.which[:, None].expand(moved.shape[:2])
    first, last = (at.movedim(-1, 0)[..., None] for at in (first, last))
    near = [
        distance(others, last) - tokens.finger,
        distance(others, (first + last) / 2.0) - tokens.finger,
        gap(tokens.laid(placed_at(pose, moved), which)[..., None], others),
        gap(tokens.laid(placed_at(pose, moved / 2.0), which)[..., None], others),
    ]
    room = torch.stack(near)
    for some in (seen.placed, ~seen.placed):  # hitting a token in its place is worse
        least = torch.where(some[:, None], room, _NEAR).amin(-1).movedim(0, -1)
        parts.append(least.clamp(-_NEAR, _NEAR) / _NEAR)
    blocked = distance(others, first).amin(-1) < tokens.finger
    return torch.cat(parts, dim=-1), beyond | blocked
