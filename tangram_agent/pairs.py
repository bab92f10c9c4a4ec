"""Pairs of one token and one piece of the target: what actor and critic for several tokens see.

A pair is seen from its token: relative to its centre, in its own orientation and, where it lies on
its other side, through a mirror. So one network knows every token, every target and both sides.

Legend: M pairs, K tokens, C corners of the largest token, F features.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from tangram_agent.graph import turn, turn_back
from tangram_sim.fitting import KINDS, kind_of
from tangram_sim.layout import Layout

# Every tan has a number of its own, whatever set it is in; other shapes share the last one.
_KINDS = len(KINDS) + 1
# Corners in radii are larger than the rest; then a perceptron's inputs are of about one size.
_CORNER_SCALE = 0.3


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
        covered: (M,) share of the piece that other tokens cover already.
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
    target_flag: Tensor

    def __init__(self, layout: Layout, arena: float) -> None:
        super().__init__()
        self.arena = arena
        self.corners = int(layout.padded_corners.shape[1])
        self.nodes = 2 * self.corners + 1
        constants = {
            "body": torch.as_tensor(layout.body[layout.padded_corners], dtype=torch.float32),
            "symmetry": torch.tensor([float(shape.symmetry) for shape in layout.shapes]),
            "radius": torch.tensor([shape.radius for shape in layout.shapes]).float(),
            "area": torch.as_tensor(layout.areas).float(),
            "kind": _kinds(layout),
            "mirror": torch.tensor([shape.mirror or 0.0 for shape in layout.shapes]).float(),
            "chiral": torch.as_tensor(layout.chiral).float(),
            "adjacency": _edges(self.corners),
            "target_flag": (torch.arange(self.nodes) > self.corners).float()[:, None],
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    @property
    def features(self) -> int:
        """F of a node."""
        return 5 + 4 + 2 * _KINDS + 4

    @property
    def inputs(self) -> int:
        """Numbers that describe a pair without nodes: what a perceptron sees."""
        return 2 + 4 + 4 * self.corners + 2 * _KINDS + 4

    def relation(self, pairs: Pairs) -> tuple[Tensor, Tensor, Tensor]:
        """The piece as its token sees it.

        Returns:
            (M, 2) where its centre is, (M,) its angle, and (M,) 1 where it lies on the other side
            than the token.
        """
        place, angle = self._seen(pairs, pairs.goal)
        # A shape that is its own mirror image is, through the mirror, turned by a known angle.
        chiral = self.chiral[pairs.piece]
        angle = angle + pairs.flipped * (1.0 - chiral) * self.mirror[pairs.piece]
        return place, angle, chiral * (pairs.flipped - pairs.goal_flipped).abs()

    def motion(self, pairs: Pairs, to: Tensor) -> Tensor:
        """The way to poses (M, 3) as tokens see it: (M, 4), shift, cosine and sine of the turn."""
        shift, angle = self._seen(pairs, to)
        return torch.cat([shift, _unit(angle)], dim=-1)

    def moved(self, pairs: Pairs, shift: Tensor, angle: Tensor) -> Tensor:
        """Poses (M, 3) after a shift (M, 2) and a turn (M,) as the token sees them."""
        sign = _signs(pairs.flipped)
        world = turn(_mirrored(shift, sign), _unit(pairs.pose[:, 2]))
        # No action reaches further than the arena's width in x and in y.
        centre = pairs.pose[:, :2] + world.clamp(-self.arena, self.arena)
        turned = pairs.pose[:, 2] + sign * angle
        return torch.cat([centre, turned[:, None]], dim=-1)

    def _seen(self, pairs: Pairs, to: Tensor) -> tuple[Tensor, Tensor]:
        """The shift (M, 2) and the turn (M,) to poses (M, 3) as tokens see them.

        Through the mirror y and angles change their sign.
        """
        sign = _signs(pairs.flipped)
        shift = turn_back(to[:, :2] - pairs.pose[:, :2], _unit(pairs.pose[:, 2]))
        return _mirrored(shift, sign), sign * (to[:, 2] - pairs.pose[:, 2])

    def vectors(self, pairs: Pairs) -> Tensor:
        """(M, inputs)."""
        place, angle, other_side = self.relation(pairs)
        radius = self.radius[pairs.token][:, None, None]
        corners = self._goal_corners(pairs, angle, other_side) + place[:, None]
        ratio, near = self._sizes(pairs, place)
        parts = [
            place,
            self._angles(pairs, angle),
            (corners / radius * _CORNER_SCALE).flatten(1),
            (self.body[pairs.token] / radius).flatten(1),
            self.kind[pairs.token],
            self.kind[pairs.piece],
            torch.stack([other_side, pairs.covered, ratio, near], dim=-1),
        ]
        return torch.cat(parts, dim=-1)

    def node_features(self, pairs: Pairs) -> Tensor:
        """(M, N, F): corners of the token, its base, corners of the piece."""
        place, angle, other_side = self.relation(pairs)
        own, offset = self.body[pairs.token], self._goal_corners(pairs, angle, other_side)
        base = torch.zeros_like(own[:, :1])
        positions = torch.cat([own, base, offset + place[:, None]], dim=1)
        radius = self.radius[pairs.token][:, None, None]
        offsets = torch.cat([own, base, offset], dim=1) / radius
        ratio, near = self._sizes(pairs, place)
        of_pair = [
            self._angles(pairs, angle),
            self.kind[pairs.token],
            self.kind[pairs.piece],
            torch.stack([ratio, near, pairs.covered, other_side], dim=-1),
        ]
        everywhere = torch.cat(of_pair, dim=-1)[:, None].expand(-1, self.nodes, -1)
        target = self.target_flag.expand(len(own), -1, -1)
        return torch.cat([positions, offsets, target, everywhere], dim=-1)

    def _goal_corners(self, pairs: Pairs, angle: Tensor, other_side: Tensor) -> Tensor:
        """Displacements (M, C, 2) of the piece's corners from its centre."""
        body = _mirrored(self.body[pairs.piece], _signs(other_side)[:, None])
        return turn(body, _unit(angle)[:, None])

    def _sizes(self, pairs: Pairs, place: Tensor) -> tuple[Tensor, Tensor]:
        """(M,) how much larger the piece is, and (M,) how near, 1 where both centres are one."""
        ratio = self.area[pairs.piece] / self.area[pairs.token]
        return ratio.log(), torch.exp(-place.norm(dim=-1) / self.radius[pairs.token])

    def _angles(self, pairs: Pairs, angle: Tensor) -> Tensor:
        """(M, 4) cosine and sine of the angle, and of it times the piece's symmetry."""
        return torch.cat([_unit(angle * self.symmetry[pairs.piece]), _unit(angle)], dim=-1)

    def turn_of(self, raw: Tensor, token: Tensor) -> Tensor:
        """Turns (M,) of pre-activations (M, 2): no more than a token's symmetry needs."""
        return torch.atan2(raw[:, 1], raw[:, 0]) / self.symmetry[token]


def _unit(angle: Tensor) -> Tensor:
    """Cosine and sine (M, 2) of angles (M,)."""
    return torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)


def _signs(flipped: Tensor) -> Tensor:
    """-1 where flipped is 1, and 1 where it is 0."""
    return 1.0 - 2.0 * flipped


def _mirrored(vectors: Tensor, sign: Tensor) -> Tensor:
    """Vectors (..., 2), their y times a sign (...)."""
    return torch.stack([vectors[..., 0], sign * vectors[..., 1]], dim=-1)


def _kinds(layout: Layout) -> Tensor:
    names = [kind_of(shape.name) for shape in layout.shapes]
    numbers = [KINDS.index(name) if name in KINDS else len(KINDS) for name in names]
    return nn.functional.one_hot(torch.tensor(numbers), _KINDS).float()


def _edges(corners: int) -> Tensor:
    """(N, N): within a piece, corner to base, base to every corner of the target's piece."""
    count = 2 * corners + 1
    edges = torch.zeros(count, count, dtype=torch.bool)
    edges[:corners, :corners] = True
    edges[corners + 1 :, corners + 1 :] = True
    edges[corners, :] = edges[:, corners] = True
    return edges & ~torch.eye(count, dtype=torch.bool)
