"""What actor and critic ask of a graph (Sec. IV-A), and the turns that its features are made of.

`SceneGraph` has all tokens and the whole target, as the paper has it. `PairGraph` has one token and
one piece of the target: with one token that is the whole scene too. The same
actor and critic work on both.

Legend here, in `scenes.py` and in `pairs.py`: M views, K tokens and V corners of a view, C corners
of the largest token, N nodes, F features. Node order: token corners, bases, target corners. A turn
is a unit complex number, stored as (cos, sin) in the last dimension. A velocity (M, 3) is
normalised: x and y times the arena's width, the angle times pi.
"""

from typing import Any, Protocol

import torch
from torch import Tensor


class Graph(Protocol):
    """What actor and critic ask of a graph; each graph knows views of its own kind.

    Attributes:
        tokens: K, in view.
        corners: V, nodes before the first base.
        adjacency: (N, N) edges.
        features: F.
        inputs: numbers that a perceptron sees of a view.
    """

    tokens: int
    corners: int
    adjacency: Tensor
    features: int
    inputs: int

    def node_features(self, view: Any, /) -> Tensor:
        """Features (M, N, F)."""

    def vectors(self, view: Any, /) -> Tensor:
        """(M, inputs): a view in one row."""

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
