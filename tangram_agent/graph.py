"""Corners and flags -> node features, and the known rigid motion of an action.

Legend: B batch, K tokens, V corners of all tokens together, N = 2V + K nodes, F features.
Node order is the layout's: token corners, bases, target corners. A turn is a unit complex number,
stored as (cos, sin) in the last dimension.
"""

import math

import torch
from torch import Tensor, nn

from tangram_agent.config import AgentConfig
from tangram_sim.layout import Layout

PAPER_FEATURES = 4


def turn(vectors: Tensor, by: Tensor) -> Tensor:
    """Rotate vectors (..., 2) by unit complex numbers (..., 2)."""
    x, y = vectors.unbind(-1)
    cos, sin = by.unbind(-1)
    return torch.stack([x * cos - y * sin, x * sin + y * cos], dim=-1)


def turn_back(vectors: Tensor, by: Tensor) -> Tensor:
    """Rotate vectors (..., 2) against unit complex numbers (..., 2)."""
    x, y = vectors.unbind(-1)
    cos, sin = by.unbind(-1)
    return torch.stack([x * cos + y * sin, y * cos - x * sin], dim=-1)


class TokenGraph(nn.Module):
    """Builds the graph of Sec. IV-A and the options that an agent may add to it.

    The edges are a constant of the layout (`adjacency`, (N, N)); only features depend on the state.
    """

    token_of_corner: Tensor
    base_weights: Tensor
    body: Tensor
    members: Tensor
    adjacency: Tensor
    symmetry: Tensor
    radius: Tensor
    token_of_node: Tensor
    piece_of_node: Tensor
    target_flag: Tensor
    chiral: Tensor

    def __init__(self, layout: Layout, arena: float, agent: AgentConfig) -> None:
        super().__init__()
        self.tokens, self.corner_count, self.nodes = (
            layout.tokens,
            layout.corner_count,
            layout.nodes,
        )
        self.arena, self.any_chiral = arena, layout.any_chiral
        self.egocentric, self.offsets = agent.egocentric, agent.offsets
        self.orientation = agent.orientation
        owner = torch.as_tensor(layout.token_of_corner)
        one_hot = torch.nn.functional.one_hot(owner, layout.tokens).T.float()
        symmetry = torch.tensor([float(shape.symmetry) for shape in layout.shapes])
        target_flag = torch.zeros(layout.nodes)
        target_flag[layout.corner_count + layout.tokens :] = 1.0
        constants = {
            "token_of_corner": owner,
            "base_weights": torch.as_tensor(layout.base_weights, dtype=torch.float32),
            "body": torch.as_tensor(layout.body, dtype=torch.float32),
            "members": one_hot,
            "adjacency": _adjacency(layout, agent.edges),
            "symmetry": symmetry,
            "radius": torch.tensor([shape.radius for shape in layout.shapes]).float(),
            # The target's piece j is token j's counterpart and counts as piece K + j.
            "token_of_node": torch.cat([owner, torch.arange(layout.tokens), owner]),
            "piece_of_node": torch.cat([owner, torch.arange(layout.tokens), layout.tokens + owner]),
            "target_flag": target_flag,
            "chiral": torch.as_tensor(layout.chiral),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    @property
    def features(self) -> int:
        """F, with the options that are switched on."""
        return PAPER_FEATURES + 2 * self.offsets + 2 * self.orientation

    def base_node(self, token: Tensor) -> Tensor:
        """Node index (B,) of the base of token (B,)."""
        return self.corner_count + token

    def centres(self, corners: Tensor) -> Tensor:
        """Centres of area (B, K, 2) of pieces with corners (B, V, 2)."""
        return self.base_weights @ corners

    def headings(self, corners: Tensor, centre: Tensor) -> Tensor:
        """Orientations (B, K, 2): the least-squares rotations from the body frame.

        From its mirror image where a token lies on its other side: the one that fits better.
        """
        offset = corners - centre[:, self.token_of_corner]
        body = self.body.expand_as(offset)
        heading: Tensor = self.members @ turn_back(offset, body)
        if self.any_chiral:
            mirrored = self.members @ turn(offset, body)
            turned_over = self.chiral & (mirrored.norm(dim=-1) > heading.norm(dim=-1))
            heading = torch.where(turned_over[..., None], mirrored, heading)
        return nn.functional.normalize(heading, dim=-1)

    def node_features(self, corners: Tensor, placed: Tensor, goal: Tensor, token: Tensor) -> Tensor:
        """Features (B, N, F).

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K), 1 where a token is placed.
            goal: (B, V, 2) corners of the target.
            token: (B,) the token that the agent is to move or has just moved.
        """
        rows = torch.arange(len(corners), device=corners.device)
        centre, goal_centre = self.centres(corners), self.centres(goal)
        positions = torch.cat([corners, centre, goal], dim=1)
        offset = self._offset(corners, centre, goal, goal_centre) if self.offsets else None
        if self.egocentric or self.orientation:
            heading = self.headings(corners, centre)
            reference = heading[rows, token][:, None]
        if self.egocentric:
            positions = turn_back(positions - centre[rows, token][:, None], reference)
            offset = None if offset is None else turn_back(offset, reference)
        parts = [positions, self._flags(placed)]
        if offset is not None:
            parts.append(offset)
        if self.orientation:
            goal_heading = self.headings(goal, goal_centre)
            parts.append(self._orientation(heading, goal_heading, reference))
        return torch.cat(parts, dim=-1)

    def _flags(self, placed: Tensor) -> Tensor:
        """Whether a node is the target's, and whether it is placed: (B, N, 2)."""
        flags = torch.cat([placed[:, self.token_of_corner], placed], dim=1)
        flags = nn.functional.pad(flags, (0, self.corner_count), value=1.0)
        return torch.stack([self.target_flag.expand_as(flags), flags], dim=-1)

    def _offset(self, corners: Tensor, centre: Tensor, goal: Tensor, goal_centre: Tensor) -> Tensor:
        """Each node's displacement from its own piece's centre, in radii: (B, N, 2)."""
        own = corners - centre[:, self.token_of_corner]
        target = goal - goal_centre[:, self.token_of_corner]
        offset = torch.cat([own, torch.zeros_like(centre), target], dim=1)
        return offset / self.radius[self.token_of_node][:, None]

    def _orientation(self, heading: Tensor, goal_heading: Tensor, reference: Tensor) -> Tensor:
        """(cos k*theta, sin k*theta) of each node's piece relative to the token: (B, N, 2)."""
        headings = torch.cat([heading, goal_heading], dim=1)
        cos, sin = turn_back(headings, reference).unbind(-1)
        angle = torch.atan2(sin, cos) * self.symmetry.repeat(2)
        per_piece = torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)
        return per_piece[:, self.piece_of_node]

    def to_world(self, corners: Tensor, token: Tensor, shift: Tensor) -> Tensor:
        """A shift (B, 2) in the token's frame as one in the world's, if the agent is egocentric."""
        if not self.egocentric:
            return shift
        return turn(shift, self._heading(corners, token))

    def to_token(self, corners: Tensor, token: Tensor, shift: Tensor) -> Tensor:
        """The inverse of `to_world`."""
        if not self.egocentric:
            return shift
        return turn_back(shift, self._heading(corners, token))

    def _heading(self, corners: Tensor, token: Tensor) -> Tensor:
        rows = torch.arange(len(corners), device=corners.device)
        return self.headings(corners, self.centres(corners))[rows, token]

    def move(self, corners: Tensor, token: Tensor, velocity: Tensor) -> Tensor:
        """Corners (B, V, 2) after the exact rigid motion of a normalised velocity (B, 3).

        The same motion as the simulation's: x and y times the arena's width, the angle times pi.
        """
        rows = torch.arange(len(corners), device=corners.device)
        centre = self.centres(corners)[rows, token][:, None]
        angle = velocity[:, 2] * math.pi
        by = torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)[:, None]
        shift = (velocity[:, :2] * self.arena)[:, None]
        moved = turn(corners - centre, by) + centre + shift
        own = self.token_of_corner[None, :] == token[:, None]
        return torch.where(own[..., None], moved, corners)


def _adjacency(layout: Layout, edges: str) -> Tensor:
    """(N, N) flags: the edges of Sec. IV-A, or all but those of a node to itself."""
    if edges == "complete":
        return ~torch.eye(layout.nodes, dtype=torch.bool)
    return torch.as_tensor(layout.adjacency)
