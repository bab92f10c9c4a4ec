"""The value network for outlines: attention over the corners of the rest.

The paper's outlook names "outline corners as nodes". Every corner of the rest sees all others.
Legend: n states, N corners, F features, W width, S different shapes.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.agents.outline.filling import UNUSED, Rests
from tangram_agent.base.config import NetConfig
from tangram_agent.nets.attention import GraphEncoder
from tangram_agent.nets.networks import untraced

_OWN = 13  # features of a corner, without the tokens that are left
_FAR = 1e4


class Corners(NamedTuple):
    """`Rests` as tensors."""

    points: Tensor
    follow: Tensor
    part: Tensor
    left: Tensor

    @staticmethod
    def of(rests: Rests, device: torch.device | None = None) -> "Corners":
        """The states as tensors on a device, cut to the corners in use to save time."""
        most = max(1, int((rests.part != UNUSED).sum(axis=1).max(initial=0)))
        columns = (part[:, :most] for part in (rests.points, rests.follow, rests.part))
        points, follow, part = (torch.from_numpy(np.ascontiguousarray(one)) for one in columns)
        left = torch.from_numpy(rests.left.astype(np.float32))
        return Corners(
            points.to(device), follow.to(device).long(), part.to(device).long(), left.to(device)
        )


class OutlineValue(nn.Module):
    """Network for the logit of the probability that the tokens left can fill the rest."""

    def __init__(self, shapes: int, net: NetConfig) -> None:
        super().__init__()
        self.encoder = GraphEncoder(_OWN + shapes, net)
        self.readout = nn.Sequential(
            nn.Linear(2 * net.width, net.width), nn.ReLU(), nn.Linear(net.width, 1)
        )

    def forward(self, corners: Corners) -> Tensor:
        """Logits (n,), equal for all states without corners."""
        untraced()
        used = corners.part != UNUSED
        edges = used[:, None, :] & used[:, :, None]
        nodes, _ = self.encoder(features(corners), edges)
        mask = used[..., None].to(nodes.dtype)
        mean = (nodes * mask).sum(dim=1) / mask.sum(dim=1).clamp(min=1.0)
        largest = (nodes - _FAR * (1.0 - mask)).amax(dim=1) * used.any(dim=1, keepdim=True)
        logits: Tensor = self.readout(torch.cat([mean, largest], dim=1)).squeeze(-1)
        return logits


def features(corners: Corners) -> Tensor:
    """Features (n, N, F): position, sides, angle and part of each corner, and the tokens left."""
    points, follow, part, left = corners
    count, most = follow.shape
    follow = follow.clamp(max=most - 1)
    before = torch.zeros_like(follow)
    before.scatter_(1, follow, torch.arange(most, device=follow.device).expand(count, -1))
    ahead = taken(points, follow) - points
    behind = taken(points, before) - points
    lengths = [side.norm(dim=-1, keepdim=True) for side in (ahead, behind)]
    out, back = (
        s / length.clamp(min=1e-6) for s, length in zip((ahead, behind), lengths, strict=True)
    )
    cosine = (out * back).sum(dim=-1)
    sine = out[..., 0] * back[..., 1] - out[..., 1] * back[..., 0]
    # Half of the cross products with the next corner add up to a part's area.
    following = points + ahead
    cross = 0.5 * (points[..., 0] * following[..., 1] - points[..., 1] * following[..., 0])
    index = torch.where(part == UNUSED, most - 1, part.clamp(max=most - 1))
    areas = torch.zeros_like(cross).scatter_add(1, index, cross)
    used = (part != UNUSED).to(points.dtype)
    parts = torch.where(part == UNUSED, -1, part).amax(dim=1, keepdim=True) + 1
    every = [
        points,
        out,
        back,
        *lengths,
        torch.stack([cosine, sine, areas.gather(1, index), parts.expand(-1, most) / 3.0], dim=-1),
        used[..., None],
        left[:, None].expand(-1, most, -1) / 2.0,
    ]
    return torch.cat(every, dim=-1) * used[..., None]


def taken(points: Tensor, index: Tensor) -> Tensor:
    """Points (n, N, 2) at indices (n, N), such as `Corners.follow`."""
    return points.gather(1, index[..., None].expand(-1, -1, points.shape[-1]))
