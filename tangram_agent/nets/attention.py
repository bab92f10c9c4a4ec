"""The multi-head-attention encoder of the graph, Eqs. 8-13.

Legend: B batch, N nodes, W width of an embedding, M heads, D = W / M key width.
"""

import math

import torch
from torch import Tensor, nn

from tangram_agent.base.config import HEADS, NetConfig

# Added to the scores of nodes without an edge: finite, but the exponential is exactly zero.
NO_EDGE = -1e30
# With at most this many nodes, torch's own softmax is slower than the plain formula.
SHORT_ROW = 16


class Drawn(nn.Linear):
    """A linear layer without bias; `initialise` draws its weights within `bound`, if given."""

    def __init__(self, inputs: int, outputs: int, bound: float | None) -> None:
        super().__init__(inputs, outputs, bias=False)
        self.bound = bound


class GraphAttention(nn.Module):
    """One MHA layer: Eqs. 9-12.

    One matrix without bias computes the keys, queries and values of all heads. Another one holds
    W_m of Eq. 12 for all heads side by side.
    """

    def __init__(self, width: int, heads: int, init: str) -> None:
        super().__init__()
        self.heads, self.key_width = heads, width // heads
        # Eq. 10 divides by d; in the authors' code that is the root of the key width.
        self.scale = 1.0 / math.sqrt(self.key_width)
        self.query_key_value = Drawn(width, 3 * width, self.scale if init == "authors" else None)
        self.combine = nn.Linear(width, width, bias=False)

    def forward(self, nodes: Tensor, edges: Tensor) -> Tensor:
        """Messages (B, N, W) from nodes (B, N, W) along edges (N, N), or (B, N, N) of each graph.

        A node without any edge gets a message of zeros.
        """
        size, count, width = nodes.shape
        joint = self.query_key_value(nodes).view(size, count, 3, self.heads, self.key_width)
        # All heads of the whole batch as one batch: (3, B * M, N, D).
        stacked = joint.permute(2, 0, 3, 1, 4).reshape(3, -1, count, self.key_width)
        query, key, value = stacked.unbind()
        if edges.ndim == 3:
            edges = edges.repeat_interleave(self.heads, dim=0)
        apart = (NO_EDGE * ~edges).expand(query.shape[0], -1, -1)
        scores = torch.baddbmm(apart, query, key.transpose(1, 2), alpha=self.scale)
        messages = softmax_mean(scores, value) * edges.any(dim=-1, keepdim=True)
        heads = messages.view(size, self.heads, count, self.key_width)
        combined: Tensor = self.combine(heads.transpose(1, 2).reshape(size, count, width))
        return combined


def softmax_mean(scores: Tensor, value: Tensor) -> Tensor:
    """softmax(scores) @ value: (B, N, N), (B, N, D) -> (B, N, D)."""
    if scores.shape[-1] > SHORT_ROW:
        return torch.softmax(scores, dim=-1) @ value
    exponential = (scores - scores.detach().amax(dim=-1, keepdim=True)).exp()
    return (exponential @ value) / exponential.sum(dim=-1, keepdim=True)


class EncoderLayer(nn.Module):
    """One round of message passing, Eq. 13: attention and g, each with a skip connection.

    g has two layers, width-feed_forward-width, with a ReLU between, as in the authors' code. A
    single layer, as in Eq. 8, would not give the paper's 504k parameters.
    """

    def __init__(self, config: NetConfig) -> None:
        super().__init__()
        self.attention = GraphAttention(config.width, HEADS, config.init)
        self.transform = nn.Sequential(
            nn.Linear(config.width, config.feed_forward),
            nn.ReLU(),
            nn.Linear(config.feed_forward, config.width),
        )

    def forward(self, nodes: Tensor, edges: Tensor) -> Tensor:
        """(B, N, W) -> (B, N, W); edges as for `GraphAttention`."""
        nodes = nodes + self.attention(nodes, edges)
        encoded: Tensor = nodes + self.transform(nodes)
        return encoded


class GraphEncoder(nn.Module):
    """Embedding of the nodes and L rounds of message passing.

    The embedding has no bias: only so the number of parameters is the paper's.
    """

    def __init__(self, features: int, config: NetConfig) -> None:
        super().__init__()
        bound = math.sqrt(12.0 / (features + config.width)) if config.init == "authors" else None
        self.embed, self.rectified = Drawn(features, config.width, bound), config.rectified
        self.layers = nn.ModuleList([EncoderLayer(config) for _ in range(config.layers)])

    def forward(self, features: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
        """Node embeddings (B, N, W) of features (B, N, F), and their mean over the graph (B, W).

        Edges are (N, N), or (B, N, N).
        """
        nodes = self.embed(features)
        if self.rectified:
            nodes = torch.relu(nodes)
        for layer in self.layers:
            nodes = layer(nodes, edges)
        return nodes, nodes.mean(dim=1)
