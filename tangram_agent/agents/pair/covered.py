"""Areas of a target's pieces that tokens cover, as tensors of fixed shapes, for acting.

`coverage.py` computes the same for learning. Legend: B scenes, K tokens, V corners of all tokens,
C of the largest, S sides of a polygon that was clipped.
"""

import torch
from torch import Tensor, nn

from tangram_agent.nets.graph import turn
from tangram_sim.geometry.layout import Layout

Lie = tuple[Tensor, Tensor, Tensor]  # result of `Covered.forward`


class Covered(nn.Module):
    """Computes the poses of tokens from their corners, and the areas that they cover."""

    owner: Tensor
    weights: Tensor
    body: Tensor
    own: Tensor
    padded: Tensor
    chiral: Tensor
    areas: Tensor

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        of_corner = torch.as_tensor(layout.token_of_corner)
        constants = {
            "owner": nn.functional.one_hot(of_corner, layout.tokens).double(),  # (V, K)
            "weights": torch.as_tensor(layout.base_weights),
            "body": torch.as_tensor(layout.body),
            "own": of_corner,
            "padded": torch.as_tensor(layout.body[layout.padded_corners]),
            "chiral": torch.as_tensor(layout.chiral),
            "areas": torch.as_tensor(layout.areas),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, corners: Tensor) -> Lie:
        """Poses of tokens with corners (B, V, 2), as in `Layout.poses` and `Layout.flipped`.

        Returns:
            Their centres (B, K, 2), their angles (B, K, 2) as cosine and sine, and (B, K) 1 where
            they lie on their other side.
        """
        centres = self.weights @ corners
        x, y = (corners - centres[:, self.own]).unbind(-1)
        own_x, own_y = self.body.unbind(-1)
        own, other = self._turned(own_x, own_y, x, y), self._turned(own_x, -own_y, x, y)
        flipped = (other.square().sum(-1) > own.square().sum(-1)) & self.chiral
        turns = torch.where(flipped[..., None], other, own)
        turns = turns / turns.square().sum(-1, keepdim=True).sqrt().clamp(min=1e-12)
        return centres, turns, flipped.to(turns.dtype)

    def _turned(self, own_x: Tensor, own_y: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """(B, K, 2) summed dot and cross products of a token's corners, as made and as seen."""
        products = own_x * x + own_y * y, own_x * y - own_y * x
        return torch.stack([one @ self.owner for one in products], dim=-1)

    def outlines(self, centres: Tensor, turns: Tensor, flipped: Tensor) -> Tensor:
        """Counter-clockwise corners (B, K, C, 2), from the result of `forward`."""
        other = self.padded.flip(1) * self.padded.new_tensor([1.0, -1.0])
        body = torch.where(flipped[..., None, None] > 0, other, self.padded)
        return centres[..., None, :] + turn(body, turns[..., None, :])

    def shares(self, tokens: Lie, pieces: Lie) -> tuple[Tensor, Tensor]:
        """Shares of pieces that tokens cover, from the poses of both; zeros for a single token.

        With a single token there is no choice, so its shares are not needed.

        Returns:
            (B, K, K) share of piece j that tokens other than i cover, and (B, K) the summed value
            of the areas that each token covers.
        """
        shared = pieces[2][:, :, None] * 0.0
        if self.areas.shape[0] > 1:
            shared = shared_areas(self.outlines(*tokens), self.outlines(*pieces))
        others = shared.sum(1, keepdim=True) - shared
        worth = shared / torch.maximum(self.areas[:, None], self.areas)
        return (others / self.areas).clamp(0.0, 1.0), worth.sum(2)


def shared_areas(first: Tensor, second: Tensor) -> Tensor:
    """Common areas (B, K, L) of convex polygons (B, K, C, 2) and others (B, L, C, 2).

    Clips sides after Sutherland and Hodgman. A side outside of a line loses its length. Each line
    adds two sides, which join the points where it was crossed.
    """
    begins, ends = first[:, :, None], first.roll(-1, 2)[:, :, None]
    for c in range(second.shape[2]):
        point = second[:, None, :, None, c]
        along = second[:, None, :, None, (c + 1) % second.shape[2]] - point
        from_, to = _cross(along, begins - point), _cross(along, ends - point)
        starts, stops = (from_ >= 0)[..., None], (to >= 0)[..., None]
        crosses = starts ^ stops
        share = (from_ / torch.where(crosses[..., 0], from_ - to, 1.0))[..., None]
        meets = begins + share * (ends - begins)
        # Along the line from the first crossing to the last: rounding may make more than two.
        at = ((meets - point) * along).sum(-1, keepdim=True)
        lowest = torch.where(crosses, at, torch.inf).amin(3, keepdim=True)
        highest = torch.where(crosses, at, -torch.inf).amax(3, keepdim=True)
        any_ = crosses.any(3, keepdim=True)
        unit = along / along.square().sum(-1, keepdim=True).clamp(min=1e-12)
        joins = [torch.where(any_, point + unit * one, 0.0) for one in (lowest, highest)]
        begins, ends = (
            torch.where(here, side, torch.where(there, meets, 0.0))
            for here, there, side in ((starts, stops, begins), (stops, starts, ends))
        )
        begins, ends = torch.cat([begins, joins[0]], 3), torch.cat([ends, joins[1]], 3)
    return _cross(begins, ends).sum(-1) / 2.0


def _cross(first: Tensor, second: Tensor) -> Tensor:
    """Cross products (...) of vectors (..., 2)."""
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
