"""Whole scenes: all tokens and the whole target in one graph, as the paper has it (Sec. IV-A)."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from tangram_agent.config import AgentConfig
from tangram_agent.graph import edges, turn, turn_back, unit
from tangram_sim.layout import Layout

PAPER_FEATURES = 4


@dataclass(frozen=True, eq=False)
class Scenes:
    """M whole scenes.

    Attributes:
        corners: (M, V, 2) of the tokens.
        placed: (M, K) 1 where a token is placed.
        goal: (M, V, 2) corners of the target.
        token: (M,) which one is to move, or has just moved.
    """

    corners: Tensor
    placed: Tensor
    goal: Tensor
    token: Tensor


def next_token(placed: Tensor) -> Tensor:
    """Which token moves, (B,): the first that is not placed (B, K); 0 where all are."""
    return (placed == 0).int().argmax(dim=-1)


class SceneGraph(nn.Module):
    """The graph of Sec. IV-A and the options that an agent may add to it.

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
        self.orientation, self.tells_edges = agent.orientation, agent.edges == "inputs"
        owner = torch.as_tensor(layout.token_of_corner)
        one_hot = nn.functional.one_hot(owner, layout.tokens).T.float()
        symmetry = torch.tensor([float(shape.symmetry) for shape in layout.shapes])
        target_flag = torch.zeros(layout.nodes)
        target_flag[layout.corner_count + layout.tokens :] = 1.0
        constants = {
            "token_of_corner": owner,
            "base_weights": torch.as_tensor(layout.base_weights, dtype=torch.float32),
            "body": torch.as_tensor(layout.body, dtype=torch.float32),
            "members": one_hot,
            "adjacency": edges(torch.as_tensor(layout.adjacency), agent.edges),
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

    @property
    def inputs(self) -> int:
        """Numbers that a perceptron sees of a scene."""
        return self.nodes * (self.features + self.nodes * self.tells_edges)

    def base_node(self, scenes: Scenes) -> Tensor:
        """Node index (M,) of the base of the token that moves."""
        return self.corner_count + scenes.token

    def slot(self, scenes: Scenes) -> Tensor:
        """(M,) which of the K tokens in view moves."""
        return scenes.token

    def symmetry_of(self, scenes: Scenes) -> Tensor:
        """(M,) symmetry order of the token that moves."""
        return self.symmetry[scenes.token]

    def centres(self, corners: Tensor) -> Tensor:
        """Centres of area (M, K, 2) of pieces with corners (M, V, 2)."""
        return self.base_weights @ corners

    def headings(self, corners: Tensor, centre: Tensor) -> Tensor:
        """Orientations (M, K, 2): the least-squares rotations from the body frame.

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

    def node_features(self, scenes: Scenes) -> Tensor:
        """Features (M, N, F)."""
        corners, goal, token = scenes.corners, scenes.goal, scenes.token
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
        parts = [positions, self._flags(scenes.placed)]
        if offset is not None:
            parts.append(offset)
        if self.orientation:
            goal_heading = self.headings(goal, goal_centre)
            parts.append(self._orientation(heading, goal_heading, reference))
        return torch.cat(parts, dim=-1)

    def vectors(self, scenes: Scenes) -> Tensor:
        """(M, inputs): the features of all nodes in one row, and perhaps the edges."""
        features = self.node_features(scenes).flatten(1)
        if not self.tells_edges:
            return features
        edges = self.adjacency.to(features.dtype).flatten().expand(len(features), -1)
        return torch.cat([features, edges], dim=1)

    def _flags(self, placed: Tensor) -> Tensor:
        """Whether a node is the target's, and whether it is placed: (M, N, 2)."""
        flags = torch.cat([placed[:, self.token_of_corner], placed], dim=1)
        flags = nn.functional.pad(flags, (0, self.corner_count), value=1.0)
        return torch.stack([self.target_flag.expand_as(flags), flags], dim=-1)

    def _offset(self, corners: Tensor, centre: Tensor, goal: Tensor, goal_centre: Tensor) -> Tensor:
        """Each node's displacement from its own piece's centre, in radii: (M, N, 2)."""
        own = corners - centre[:, self.token_of_corner]
        target = goal - goal_centre[:, self.token_of_corner]
        offset = torch.cat([own, torch.zeros_like(centre), target], dim=1)
        return offset / self.radius[self.token_of_node][:, None]

    def _orientation(self, heading: Tensor, goal_heading: Tensor, reference: Tensor) -> Tensor:
        """(cos k*theta, sin k*theta) of each node's piece relative to the token: (M, N, 2)."""
        headings = torch.cat([heading, goal_heading], dim=1)
        cos, sin = turn_back(headings, reference).unbind(-1)
        per_piece = unit(torch.atan2(sin, cos) * self.symmetry.repeat(2))
        return per_piece[:, self.piece_of_node]

    def velocity(self, scenes: Scenes, shift: Tensor, angle: Tensor) -> Tensor:
        """The velocity (M, 3) of a shift (M, 2), as the token sees it, and a turn (M,) over pi."""
        if self.egocentric:
            shift = turn(shift, self._heading(scenes))
        return torch.cat([shift, angle[:, None]], dim=-1).clamp(-1.0, 1.0)

    def as_seen(self, scenes: Scenes, velocity: Tensor) -> Tensor:
        """A velocity (M, 3) as the token sees it."""
        if not self.egocentric:
            return velocity
        shift = turn_back(velocity[:, :2], self._heading(scenes))
        return torch.cat([shift, velocity[:, 2:]], dim=-1)

    def _heading(self, scenes: Scenes) -> Tensor:
        corners = scenes.corners
        rows = torch.arange(len(corners), device=corners.device)
        return self.headings(corners, self.centres(corners))[rows, scenes.token]

    def moved(self, scenes: Scenes, velocity: Tensor) -> Scenes:
        """The scenes after the exact rigid motion of a velocity (M, 3)."""
        corners, token = scenes.corners, scenes.token
        rows = torch.arange(len(corners), device=corners.device)
        centre = self.centres(corners)[rows, token][:, None]
        by = unit(velocity[:, 2] * math.pi)[:, None]
        shift = (velocity[:, :2] * self.arena)[:, None]
        moved = turn(corners - centre, by) + centre + shift
        own = self.token_of_corner[None, :] == token[:, None]
        return replace(scenes, corners=torch.where(own[..., None], moved, corners))
