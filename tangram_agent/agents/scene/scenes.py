"""Whole scenes: all tokens and the whole target in one graph, as in the paper (Sec. IV-A)."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from tangram_sim.geometry.layout import Layout
from tangram_tasks.played import closed


@dataclass(frozen=True, eq=False)
class Scenes:
    """M whole scenes of K tokens with V corners in all.

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
    """Index (B,) of the token that moves: the first not placed (B, K); 0 if all are placed."""
    return (placed == 0).int().argmax(dim=-1)


def whole(seen: Mapping[str, Tensor]) -> Scenes:
    """Scenes from a task's fields (B, ...), by name; the next token is to move."""
    placed = closed(seen)
    return Scenes(seen["corners"], placed, seen["goals"], next_token(placed))


class SceneGraph(nn.Module):
    """The graph of Sec. IV-A, with four features for each node, in the arena's coordinates.

    The edges are a constant of the layout (`adjacency`, (N, N)); only features depend on the state.
    """

    token_of_corner: Tensor
    base_weights: Tensor
    adjacency: Tensor
    target_flag: Tensor

    def __init__(self, layout: Layout, flags: bool = True) -> None:
        """Make the constants; without `flags` all tokens look placed, and `vectors` omits flags."""
        super().__init__()
        self.tokens, self.corners, self.nodes = layout.tokens, layout.corner_count, layout.nodes
        self.features, self.flags = 4, flags
        self.inputs = (4 if flags else 2) * self.nodes
        target_flag = torch.zeros(layout.nodes)
        target_flag[layout.corner_count + layout.tokens :] = 1.0
        constants = {
            "token_of_corner": torch.as_tensor(layout.token_of_corner),
            "base_weights": torch.as_tensor(layout.base_weights, dtype=torch.float32),
            "adjacency": torch.as_tensor(layout.adjacency),
            "target_flag": target_flag,
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def base_node(self, scenes: Scenes) -> Tensor:
        """Node index (M,) of the base of the token that moves."""
        return self.corners + scenes.token

    def node_features(self, scenes: Scenes) -> Tensor:
        """Features (M, N, F): position, 1 for nodes of the target, 1 for nodes of placed tokens."""
        corners, goal = scenes.corners, scenes.goal
        positions = torch.cat([corners, self.base_weights @ corners, goal], dim=1)
        placed = scenes.placed if self.flags else torch.ones_like(scenes.placed)
        flags = torch.cat([placed[:, self.token_of_corner], placed], dim=1)
        flags = nn.functional.pad(flags, (0, self.corners), value=1.0)
        target = self.target_flag.expand_as(flags)
        return torch.cat([positions, torch.stack([target, flags], dim=-1)], dim=-1)

    def vectors(self, scenes: Scenes) -> Tensor:
        """Inputs (M, inputs) of a perceptron: the features of all nodes in one row."""
        features = self.node_features(scenes)
        return (features if self.flags else features[..., :2]).flatten(1)
