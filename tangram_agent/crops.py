"""What is left to fill -> whether it can be filled: convolutions over a small picture of it.

The other way beside `values.py`: the same states, drawn. What is left has no token's frame any
more, so it is seen in that of its longest side, along which an edge of a token that fills it lies,
but for some eighths of a turn; and so it looks the same wherever it lies.

Legend: n states, N corners, P pixels of a side, L strips of columns, S different shapes.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn

from tangram_agent.config import NetConfig
from tangram_agent.filling import UNUSED
from tangram_agent.values import Corners, taken

PIXELS = 32
SIDE = 3.0  # of a picture, in units of the root of all tokens' area: 99 in 100 gluings are smaller
_STRIPS = 2  # in each column of pixels
_FAR = 1e4
_KERNEL = 3


class CropValue(nn.Module):
    """The logit of the probability that the tokens left can fill what is left, by its picture."""

    def __init__(self, shapes: int, net: NetConfig) -> None:
        super().__init__()
        channels = (1, *net.hidden)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(given, made, _KERNEL, stride=2, padding=_KERNEL // 2)
            for given, made in pairwise(channels)
        )
        # The same for every pixel, as if each were told the tokens left.
        self.told = nn.Linear(shapes, net.hidden[0], bias=False)
        side = PIXELS
        for _ in net.hidden:
            side = (side + 1) // 2
        width = net.hidden[-1]
        self.readout = nn.Sequential(
            nn.Linear(width * side * side + shapes, width), nn.ReLU(), nn.Linear(width, 1)
        )

    def forward(self, corners: Corners) -> Tensor:
        """(n,) logits, the same for every state without corners."""
        used = (corners.part != UNUSED).any(dim=1, keepdim=True)
        left = corners.left * used / 2.0
        seen = pictures(corners)[:, None]
        for i, convolution in enumerate(self.convolutions):
            seen = convolution(seen)
            if i == 0:
                seen = seen + self.told(left)[..., None, None]
            seen = torch.relu(seen)
        logits: Tensor = self.readout(torch.cat([seen.flatten(1), left], dim=1)).squeeze(-1)
        return logits


def pictures(corners: Corners) -> Tensor:
    """(n, P, P) share of each pixel that is to fill, row by row from the lowest y.

    The middle of what is left, by its extent, is that of the picture; what is larger than the
    picture is drawn smaller. All pixels together have the exact area, and so has each one that no
    side passes aslant; where one does, its height is that in the middle of each strip.
    """
    points, used = _on_pixels(corners), corners.part != UNUSED
    count, most = used.shape
    ends = taken(points, corners.follow.clamp(max=most - 1))
    (x, y), (to_x, to_y) = (one[:, None].unbind(dim=-1) for one in (points, ends))
    strips = torch.arange(PIXELS * _STRIPS, device=points.device, dtype=points.dtype)[:, None]
    # What of a strip (n, L, N) a side runs over, and how high it is in the middle of that.
    low = torch.maximum(torch.minimum(x, to_x), strips / _STRIPS)
    high = torch.minimum(torch.maximum(x, to_x), (strips + 1.0) / _STRIPS)
    over = (high - low).clamp(min=0.0) * _STRIPS * used[:, None]
    slope = (to_y - y) / torch.where(x == to_x, 1.0, to_x - x)
    height = (y + ((low + high) / 2.0 - x) * slope).clamp(0.0, PIXELS)
    # What is to fill lies to the left of a side: below one that runs back along x, where it counts,
    # above one that runs ahead, so that what is below that one does not.
    weight = torch.sign(x - to_x) * over
    # Each side adds its weight to all pixels below it and a share of that to the one it passes:
    # as steps from pixel to pixel, whose sums from above are the shares.
    row = height.floor().clamp(max=PIXELS - 1)
    share, slot = height - row, row.long()
    steps = points.new_zeros(count, len(strips), PIXELS + 1)
    steps.scatter_add_(2, slot + 1, weight * share)
    steps.scatter_add_(2, slot, weight * (1.0 - share))
    shares = steps.flip(2).cumsum(dim=2).flip(2)[..., 1:]
    columns = shares.view(count, PIXELS, _STRIPS, PIXELS).mean(dim=2)
    return columns.transpose(1, 2).clamp(0.0, 1.0)


def _on_pixels(corners: Corners) -> Tensor:
    """(n, N, 2) corners in pixels from the picture's lowest x and y."""
    points, unused = corners.points, (corners.part == UNUSED)[..., None]
    low = torch.where(unused, _FAR, points).amin(dim=1, keepdim=True)
    high = torch.where(unused, -_FAR, points).amax(dim=1, keepdim=True)
    extent = (high - low).amax(dim=2, keepdim=True).clamp(min=SIDE)
    return ((points - (low + high) / 2.0) / extent + 0.5) * PIXELS
