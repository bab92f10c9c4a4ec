"""Pairs of one token and one piece of the target, each a graph of its own."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from tangram_agent.nets.graph import turn, turn_back, unit
from tangram_sim.geometry.fitting import KINDS, kind_of
from tangram_sim.geometry.layout import Layout

# Every tangram shape has the same number in all sets; other shapes share the last number.
_KINDS = len(KINDS) + 1
_ANGLES = 5  # features of a piece's angle
# Corners in units of radii are large: scaled, all inputs of a perceptron have about one size.
_CORNER_SCALE = 0.3


@dataclass(frozen=True, eq=False)
class Pairs:
    """M pairs of one token and one piece of the target.

    Networks see a pair from its token: relative to its centre, in its orientation, and mirrored
    where the token lies on its other side. So one network serves all tokens, targets and sides.

    Attributes:
        pose: (M, 3) x, y and angle of the token.
        flipped: (M,) 1 where the token lies on its other side.
        token: (M,) index of the token.
        goal: (M, 3) pose of the target's piece.
        goal_flipped: (M,) 1 where the piece lies on its other side.
        piece: (M,) index of the piece.
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
        """The same pairs with their tokens at other poses (M, 3)."""
        return replace(self, pose=pose)


class PairGraph(nn.Module):
    """The graph of a pair: the token's corners, its base, the target piece's corners.

    The edges are those of Sec. IV-A. Shapes with fewer corners repeat their last one. Coordinates
    are relative to the token, in its orientation. Every node also has its displacement from its
    centre, the angle, both shapes and the covered share of the piece.
    """

    tokens = 1  # in view
    body: Tensor
    full_scale: Tensor
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
        self.corners = int(layout.padded_corners.shape[1])
        self.nodes = 2 * self.corners + 1
        self.features = 9 + _ANGLES + 2 * _KINDS
        self.inputs = 2 * (1 + 2 * self.corners) + _ANGLES + 2 * _KINDS + 4
        constants = {
            "full_scale": torch.tensor([arena, arena, math.pi]),
            "body": torch.as_tensor(layout.body[layout.padded_corners], dtype=torch.float32),
            "symmetry": torch.tensor([float(shape.symmetry) for shape in layout.shapes]),
            "radius": torch.tensor([shape.radius for shape in layout.shapes]).float(),
            "area": torch.as_tensor(layout.areas).float(),
            "kind": _kinds(layout),
            "mirror": torch.tensor([shape.mirror or 0.0 for shape in layout.shapes]).float(),
            "chiral": torch.as_tensor(layout.chiral).float(),
            "adjacency": _pair_adjacency(self.corners),
            "target_flag": (torch.arange(self.nodes) > self.corners).float()[:, None],
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def base_node(self, pairs: Pairs) -> Tensor:
        """Node index (M,) of the token's base."""
        return torch.full_like(pairs.token, self.corners)

    def relation(self, pairs: Pairs) -> tuple[Tensor, Tensor, Tensor]:
        """The pose of the piece relative to its token.

        Returns:
            (M, 2) the piece's centre, (M,) its angle, and (M,) 1 where token and piece lie on
            different sides.
        """
        # A mirror changes the sign of y and of angles.
        sign = _signs(pairs.flipped)
        shift = turn_back(pairs.goal[:, :2] - pairs.pose[:, :2], unit(pairs.pose[:, 2]))
        place, angle = _mirrored(shift, sign), sign * (pairs.goal[:, 2] - pairs.pose[:, 2])
        # A mirror turns a shape that is its own mirror image by a known angle.
        chiral = self.chiral[pairs.piece]
        angle = angle + pairs.flipped * (1.0 - chiral) * self.mirror[pairs.piece]
        return place, angle, chiral * (pairs.flipped - pairs.goal_flipped).abs()

    def velocity(self, pairs: Pairs, shift: Tensor, angle: Tensor) -> Tensor:
        """Velocities (M, 3) from shifts (M, 2) in the token's frame and turns (M,) over pi."""
        sign = _signs(pairs.flipped)
        shift = turn(_mirrored(shift, sign), unit(pairs.pose[:, 2]))
        return torch.cat([shift, (sign * angle)[:, None]], dim=-1).clamp(-1.0, 1.0)

    def moved(self, pairs: Pairs, velocity: Tensor) -> Pairs:
        """The pairs after the exact rigid motion by velocities (M, 3), as in the simulation."""
        return pairs.at(pairs.pose + velocity * self.full_scale)

    def way(self, pairs: Pairs, to: Tensor) -> Tensor:
        """The velocity (M, 3) that takes tokens to poses (M, 3), by the shorter turn."""
        way = to - pairs.pose
        turned = torch.remainder(way[:, 2:] + math.pi, 2.0 * math.pi) - math.pi
        return torch.cat([way[:, :2], turned], dim=-1) / self.full_scale

    def vectors(self, pairs: Pairs) -> Tensor:
        """Inputs (M, inputs) of a perceptron: each pair in one row."""
        place, angle, other_side = self.relation(pairs)
        radius = self.radius[pairs.token][:, None, None]
        own, offset = self._bodies(pairs, angle, other_side)
        ratio, near = self._sizes(pairs, place)
        parts = [
            place,
            self._angles(pairs, angle),
            ((offset + place[:, None]) / radius * _CORNER_SCALE).flatten(1),
            (own / radius).flatten(1),
            self.kind[pairs.token],
            self.kind[pairs.piece],
            torch.stack([other_side, pairs.covered, ratio, near], dim=-1),
        ]
        return torch.cat(parts, dim=-1)

    def node_features(self, pairs: Pairs) -> Tensor:
        """Node features (M, N, F): corners of the token, its base, corners of the piece."""
        place, angle, other_side = self.relation(pairs)
        own, offset = self._bodies(pairs, angle, other_side)
        base = torch.zeros_like(own[:, :1])
        positions = torch.cat([own, base, offset + place[:, None]], dim=1)
        offsets = torch.cat([own, base, offset], dim=1) / self.radius[pairs.token][:, None, None]
        ratio, near = self._sizes(pairs, place)
        of_pair = [
            self._angles(pairs, angle),
            self.kind[pairs.token],
            self.kind[pairs.piece],
            torch.stack([ratio, near, pairs.covered, other_side], dim=-1),
        ]
        everywhere = torch.cat(of_pair, dim=-1)[:, None].expand(-1, self.nodes, -1)
        target = self.target_flag.expand(own.shape[0], -1, -1)
        return torch.cat([positions, offsets, target, everywhere], dim=-1)

    def _bodies(self, pairs: Pairs, angle: Tensor, other_side: Tensor) -> tuple[Tensor, Tensor]:
        """Displacements (M, C, 2) of the token's corners and of the piece's, from their centres."""
        body = _mirrored(self.body[pairs.piece], _signs(other_side)[:, None])
        return self.body[pairs.token], turn(body, unit(angle)[:, None])

    def _sizes(self, pairs: Pairs, place: Tensor) -> tuple[Tensor, Tensor]:
        """(M,) log ratio of the areas of piece and token, and (M,) nearness, 1 at equal centres."""
        ratio = self.area[pairs.piece] / self.area[pairs.token]
        return ratio.log(), torch.exp(-place.norm(dim=-1) / self.radius[pairs.token])

    def _angles(self, pairs: Pairs, angle: Tensor) -> Tensor:
        """Features (M, 5): cosine and sine of angle times symmetry, those of the angle; alignment.

        The reward has a cusp where both are aligned. With smooth features alone the critic has its
        maximum beside the cusp: trained agents were up to 0.14 degrees off.
        """
        symmetry = self.symmetry[pairs.piece]
        folded = unit(angle * symmetry)
        aligned = torch.exp(-torch.atan2(folded[:, 1], folded[:, 0]).abs() / symmetry)
        return torch.cat([folded, unit(angle), aligned[:, None]], dim=-1)


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


def _pair_adjacency(corners: int) -> Tensor:
    """(N, N): within a piece, corner to base, base to every corner of the target's piece."""
    count = 2 * corners + 1
    edges = torch.zeros(count, count, dtype=torch.bool)
    edges[:corners, :corners] = True
    edges[corners + 1 :, corners + 1 :] = True
    edges[corners, :] = edges[:, corners] = True
    return edges & ~torch.eye(count, dtype=torch.bool)
