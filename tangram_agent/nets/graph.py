"""The interface of a graph for actor and critic (Sec. IV-A), and rotations for its features.

`SceneGraph` has all tokens and the whole target, as in the paper. `PairGraph` has one token and one
piece of the target: with one token that is the whole scene, too. The same `Head` reads both.

Legend here, in `scenes.py` and in `pairs.py`: M views, K tokens and V corners of a view, C corners
of the largest token, N nodes, F features. Node order: token corners, bases, target corners. A turn
is a unit complex number, stored as (cos, sin) in the last dimension. A velocity (M, 3) is
normalised: the unit of x and y is the arena's width, that of the angle is pi.
"""

from typing import Any, Protocol

import torch
from torch import Tensor


class Graph(Protocol):
    """The interface of a graph for actor and critic; each graph has its own type of view.

    Attributes:
        tokens: K, tokens of a view.
        corners: V, nodes before the first base.
        adjacency: (N, N) edges.
        features: F, features of a node.
        inputs: numbers of a view for a perceptron.
    """

    tokens: int
    corners: int
    adjacency: Tensor
    features: int
    inputs: int

    def node_features(self, view: Any, /) -> Tensor:
        """Features (M, N, F)."""

    def vectors(self, view: Any, /) -> Tensor:
        """Inputs (M, inputs) of a perceptron: each view in one row."""

    def base_node(self, view: Any, /) -> Tensor:
        """Node index (M,) of the base of the token that moves."""


def unit(angle: Tensor) -> Tensor:
    """Cosine and sine (..., 2) of angles (...)."""
    return torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)


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
