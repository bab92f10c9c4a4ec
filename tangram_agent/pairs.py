"""Pairs of one token and one piece of the target: what actor and critic for several tokens see.

A pair is seen from its token: relative to its centre, in its own orientation and, where it lies on
its other side, through a mirror. So one network knows every token, every target and both sides.

Legend: M pairs, K tokens, C corners of the largest token, F features.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from tangram_agent.graph import turn, turn_back
from tangram_sim.layout import Layout

# Every tan has a number of its own, whatever set it is in; other shapes share the last one.
KINDS = ("large_triangle", "medium_triangle", "small_triangle", "square", "parallelogram")
_MIRROR_NAMES = {"parallelogram_mirrored": "parallelogram"}


@dataclass(frozen=True, eq=False)
class Pairs:
    """M pairs.

    Attributes:
        pose: (M, 3) x, y and angle of the token.
        flipped: (M,) 1 where it lies on its other side.
        token: (M,) its index.
        goal: (M, 3) pose of the target's piece.
        goal_flipped: (M,) 1 where that lies on its other side.
        piece: (M,) its index.
        covered: (M,) share of the piece that placed tokens cover already.
    """

    pose: Tensor
    flipped: Tensor
    token: Tensor
    goal: Tensor
    goal_flipped: Tensor
    piece: Tensor
    covered: Tensor

    def at(self, pose: Tensor) -> "Pairs":
        """The same pairs with their tokens elsewhere."""
        return replace(self, pose=pose)


class PairGraph(nn.Module):
    """Builds the graph of a pair: the token's corners, its base, the target piece's corners.

    The edges are those of Sec. IV-A. Shapes of fewer corners repeat their last one.
    """

    body: Tensor
    symmetry: Tensor
    radius: Tensor
    area: Tensor
    kind: Tensor
    mirror: Tensor
    chiral: Tensor
    adjacency: Tensor

    def __init__(self, layout: Layout, arena: float) -> None:
        super().__init__()
        self.arena, self.tokens = arena, layout.tokens
        self.corners = int(layout.padded_corners.shape[1])
        self.nodes = 2 * self.corners + 1
        constants = {
            "body": torch.as_tensor(layout.body[layout.padded_corners], dtype=torch.float32),
            "symmetry": torch.tensor([float(shape.symmetry) for shape in layout.shapes]),
            "radius": torch.tensor([shape.radius for shape in layout.shapes]).float(),
            "area": torch.tensor([shape.area for shape in layout.shapes]).float(),
            "kind": _kinds(layout),
            "mirror": torch.tensor([shape.mirror or 0.0 for shape in layout.shapes]).float(),
            "chiral": torch.as_tensor(layout.chiral).float(),
            "adjacency": _edges(self.corners),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    @property
    def features(self) -> int:
        """F of a node."""
        return 5 + 4 + 2 * (len(KINDS) + 1) + 4

    @property
    def inputs(self) -> int:
        """Numbers that describe a pair without nodes: what a perceptron sees."""
        return 2 + 4 + 4 * self.corners + 2 * (len(KINDS) + 1) + 4

    def base_node(self, token: Tensor) -> Tensor:
        """Node index (M,) of the token's base."""
        return torch.full_like(token, self.corners)

    def relation(self, pairs: Pairs) -> tuple[Tensor, Tensor, Tensor]:
        """The piece as its token sees it.

        Returns:
            (M, 2) where its centre is, (M,) its angle, and (M,) 1 where it lies on the other side
            than the token.
        """
        heading = torch.stack([torch.cos(pairs.pose[:, 2]), torch.sin(pairs.pose[:, 2])], dim=-1)
        place = turn_back(pairs.goal[:, :2] - pairs.pose[:, :2], heading)
        angle = pairs.goal[:, 2] - pairs.pose[:, 2]
        # Through the mirror y and angles change their sign; a shape that is its own mirror image
        # is then turned by a known angle.
        sign = 1.0 - 2.0 * pairs.flipped
        chiral = self.chiral[pairs.piece]
        angle = sign * angle + pairs.flipped * (1.0 - chiral) * self.mirror[pairs.piece]
        place = torch.stack([place[:, 0], sign * place[:, 1]], dim=-1)
        other_side = chiral * (pairs.flipped - pairs.goal_flipped).abs()
        return place, angle, other_side

    def motion(self, pairs: Pairs, to: Tensor) -> Tensor:
        """The way to poses (M, 3) as tokens see it: (M, 4), shift, cosine and sine of the turn."""
        heading = torch.stack([torch.cos(pairs.pose[:, 2]), torch.sin(pairs.pose[:, 2])], dim=-1)
        shift = turn_back(to[:, :2] - pairs.pose[:, :2], heading)
        sign = 1.0 - 2.0 * pairs.flipped
        angle = sign * (to[:, 2] - pairs.pose[:, 2])
        parts = [shift[:, 0], sign * shift[:, 1], torch.cos(angle), torch.sin(angle)]
        return torch.stack(parts, dim=-1)

    def moved(self, pairs: Pairs, shift: Tensor, angle: Tensor) -> Tensor:
        """Poses (M, 3) after a shift (M, 2) and a turn (M,) as the token sees them."""
        heading = torch.stack([torch.cos(pairs.pose[:, 2]), torch.sin(pairs.pose[:, 2])], dim=-1)
        sign = 1.0 - 2.0 * pairs.flipped
        own = torch.stack([shift[:, 0], sign * shift[:, 1]], dim=-1)
        # No action reaches further than the arena's width in x and in y.
        world = turn(own, heading).clamp(-self.arena, self.arena)
        turned = pairs.pose[:, 2] + sign * angle
        return torch.cat([pairs.pose[:, :2] + world, turned[:, None]], dim=-1)

    def _goal_corners(self, pairs: Pairs, angle: Tensor, other_side: Tensor) -> Tensor:
        """Displacements (M, C, 2) of the piece's corners from its centre."""
        body = self.body[pairs.piece]
        sides = (1.0 - 2.0 * other_side)[:, None]
        flat = torch.stack([body[..., 0], sides * body[..., 1]], dim=-1)
        return turn(flat, torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)[:, None])

    def vectors(self, pairs: Pairs) -> Tensor:
        """(M, inputs)."""
        place, angle, other_side = self.relation(pairs)
        radius = self.radius[pairs.token][:, None]
        corners = self._goal_corners(pairs, angle, other_side) + place[:, None]
        near = torch.exp(-(place / radius).norm(dim=-1))
        ratio = (self.area[pairs.piece] / self.area[pairs.token]).log()
        return torch.cat(
            [
                place,
                self._angles(pairs, angle),
                (corners / radius[:, None] * _CORNER_SCALE).flatten(1),
                (self.body[pairs.token] / radius[:, None]).flatten(1),
                self.kind[pairs.token],
                self.kind[pairs.piece],
                torch.stack([other_side, pairs.covered, ratio, near], dim=-1),
            ],
            dim=-1,
        )

    def node_features(self, pairs: Pairs) -> Tensor:
        """(M, N, F), corners of the token, its base, corners of the piece."""
        place, angle, other_side = self.relation(pairs)
        radius = self.radius[pairs.token][:, None, None]
        own, count = self.body[pairs.token], self.corners
        offset = self._goal_corners(pairs, angle, other_side)
        base = torch.zeros_like(own[:, :1])
        positions = torch.cat([own, base, offset + place[:, None]], dim=1)
        offsets = torch.cat([own, base, offset], dim=1) / radius
        ratio = (self.area[pairs.piece] / self.area[pairs.token]).log()
        near = torch.exp(-(place / radius[:, 0]).norm(dim=-1))
        of_pair = [ratio, near, pairs.covered, other_side]
        shared = torch.cat(
            [
                self._angles(pairs, angle),
                self.kind[pairs.token],
                self.kind[pairs.piece],
                torch.stack(of_pair, dim=-1),
            ],
            dim=-1,
        )
        target = torch.zeros_like(positions[..., :1])
        target[:, count + 1 :] = 1.0
        everywhere = shared[:, None].expand(-1, self.nodes, -1)
        return torch.cat([positions, offsets, target, everywhere], dim=-1)

    def _angles(self, pairs: Pairs, angle: Tensor) -> Tensor:
        """(M, 4) cosine and sine of the angle, and of it times the piece's symmetry."""
        folded = angle * self.symmetry[pairs.piece]
        parts = [torch.cos(folded), torch.sin(folded), torch.cos(angle), torch.sin(angle)]
        return torch.stack(parts, dim=-1)

    def turn_of(self, raw: Tensor, token: Tensor) -> Tensor:
        """Turns (M,) of pre-activations (M, 2): no more than a token's symmetry needs."""
        return torch.atan2(raw[:, 1], raw[:, 0]) / self.symmetry[token]


# Corners in radii are larger than the rest; then features are of about one size.
_CORNER_SCALE = 0.3


def _kinds(layout: Layout) -> Tensor:
    names = [_MIRROR_NAMES.get(shape.name, shape.name) for shape in layout.shapes]
    numbers = [KINDS.index(name) if name in KINDS else len(KINDS) for name in names]
    return nn.functional.one_hot(torch.tensor(numbers), len(KINDS) + 1).float()


def _edges(corners: int) -> Tensor:
    """(N, N): within a piece, corner to base, base to every corner of the target's piece."""
    count = 2 * corners + 1
    edges = torch.zeros(count, count, dtype=torch.bool)
    edges[:corners, :corners] = True
    edges[corners + 1 :, corners + 1 :] = True
    edges[corners, :] = edges[:, corners] = True
    return edges & ~torch.eye(count, dtype=torch.bool)
