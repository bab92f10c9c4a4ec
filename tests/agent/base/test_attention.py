"""The encoder against loops written from Eqs. 8-13, and what masks must do."""

import numpy as np
import pytest
import torch

from tangram_agent.base.config import NetConfig
from tangram_agent.nets.attention import (
    NO_EDGE,
    SHORT_ROW,
    GraphAttention,
    GraphEncoder,
    softmax_mean,
)
from tangram_agent.nets.networks import initialise
from tests.agent.builders import setup

pytestmark = pytest.mark.fast

WIDTH, HEADS, NODES = 16, 4, 9


def attention() -> GraphAttention:
    layer = GraphAttention(WIDTH, HEADS, "fan_in")
    initialise(layer, torch.Generator().manual_seed(3))
    return layer


def slow_attention(layer: GraphAttention, nodes: np.ndarray, edges: np.ndarray):
    """Eqs. 9-12 for one graph, node by node and head by head; d is the root of the key width."""
    d = 2.0
    count, width = nodes.shape
    key_width = width // layer.heads
    stacked = layer.query_key_value.weight.detach().numpy().astype(np.float64)
    w_q, w_k, w_v = stacked.reshape(3, layer.heads, key_width, width)
    w_m = layer.combine.weight.detach().numpy().astype(np.float64)
    result = np.zeros((count, width))
    for i in range(count):
        for head in range(layer.heads):
            seen, query = np.flatnonzero(edges[i]), w_q[head] @ nodes[i]
            weights = np.exp([query @ (w_k[head] @ nodes[j]) / d for j in seen])
            message = sum(w * (w_v[head] @ nodes[j]) for w, j in zip(weights, seen, strict=True))
            columns = slice(head * key_width, (head + 1) * key_width)
            result[i] += w_m[:, columns] @ message / weights.sum()
    return result


def test_attention_equals_the_loop_of_the_equations() -> None:
    layer = attention()
    edges = setup().task.layout.adjacency
    nodes = np.random.default_rng(0).standard_normal((5, NODES, WIDTH)).astype(np.float32)
    fast = layer(torch.from_numpy(nodes), torch.from_numpy(edges)).detach().numpy()
    for graph, expected in zip(nodes, fast, strict=True):
        np.testing.assert_allclose(slow_attention(layer, graph, edges), expected, atol=1e-5)


@pytest.mark.parametrize("rectified", [False, True])
def test_encoder_equals_the_loop_of_the_equations(rectified: bool) -> None:
    """Eq. 13 over two rounds, with both readings of the embedding."""
    config = NetConfig(width=WIDTH, layers=2, feed_forward=20, rectified=rectified)
    encoder = GraphEncoder(4, config)
    initialise(encoder, torch.Generator().manual_seed(1))
    edges = setup().task.layout.adjacency
    features = np.random.default_rng(1).standard_normal((1, NODES, 4)).astype(np.float32)
    found, mean = encoder(torch.from_numpy(features), torch.from_numpy(edges))

    nodes = features[0].astype(np.float64) @ encoder.embed.weight.detach().numpy().T
    nodes = np.maximum(nodes, 0.0) if rectified else nodes
    for layer in encoder.layers:
        nodes = nodes + slow_attention(layer.attention, nodes, edges)
        hidden = nodes
        for part in layer.transform:
            if isinstance(part, torch.nn.Linear):
                hidden = hidden @ part.weight.detach().numpy().T + part.bias.detach().numpy()
            else:
                hidden = np.maximum(hidden, 0.0)
        nodes = nodes + hidden
    np.testing.assert_allclose(found[0].detach().numpy(), nodes, atol=1e-5)
    np.testing.assert_allclose(mean[0].detach().numpy(), nodes.mean(axis=0), atol=1e-5)


@pytest.mark.parametrize(
    ("init", "embedding", "keys"),
    [("fan_in", 1 / 2, 1 / 4), ("authors", (12 / (4 + WIDTH)) ** 0.5, 1 / 2)],
)
def test_weights_are_drawn_within_their_bounds(init: str, embedding: float, keys: float) -> None:
    encoder = GraphEncoder(4, NetConfig(width=WIDTH, init=init))
    initialise(encoder, torch.Generator().manual_seed(1))
    attention = encoder.layers[0].attention
    for layer, bound in (
        (encoder.embed, embedding),
        (attention.query_key_value, keys),
        (attention.combine, 1 / 4),
    ):
        assert 0.9 * bound < layer.weight.detach().abs().max().item() < 1.0001 * bound


def test_without_an_edge_there_is_no_influence() -> None:
    """Eq. 10: where E(i, j) = 0, j sends nothing to i in one round; i's own query counts."""
    layer, layout = attention(), setup().task.layout
    edges = torch.from_numpy(layout.adjacency)
    nodes = torch.randn(1, NODES, WIDTH, generator=torch.Generator().manual_seed(0))
    before = layer(nodes, edges)[0]
    for j in range(NODES):
        changed = nodes.clone()
        changed[0, j] += 1.0
        moved = (layer(changed, edges)[0] - before).abs().sum(dim=-1) > 1e-6
        expected = layout.adjacency[:, j].copy()
        expected[j] = True
        assert moved.tolist() == expected.tolist()
    alone = edges.clone()
    alone[2] = False  # no edges: no message
    messages = layer(nodes, alone)[0]
    assert torch.isfinite(messages).all()
    assert [bool(message.any()) for message in messages] == [node != 2 for node in range(NODES)]


@pytest.mark.parametrize("count", [1, 3, SHORT_ROW, SHORT_ROW + 1, 53])
def test_the_mean_is_that_of_torchs_softmax(count: int) -> None:
    """Also with scores whose exponentials overflow, and where edges are missing."""
    generator = torch.Generator().manual_seed(count)
    scores = 200.0 * torch.randn(4, count, count, generator=generator, dtype=torch.float32)
    scores[:, :, 0].mul_(torch.tensor([1.0, 1.0, 0.0, 0.0])[:, None])
    scores[2, :, 1:] = NO_EDGE
    value = torch.randn(4, count, 5, generator=generator)
    expected = torch.softmax(scores, dim=-1) @ value
    torch.testing.assert_close(softmax_mean(scores, value), expected)
