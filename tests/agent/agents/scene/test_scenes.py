"""Features against the layout's own, and hand-made scenes."""

import numpy as np
import pytest
import torch

from tangram_agent.agents.scene.scenes import SceneGraph, Scenes
from tangram_core.setup import Setup
from tests.agent.builders import PAIR, PAPER, SQUARE, random_transitions, setup

pytestmark = pytest.mark.fast


def graph_of(made: Setup) -> SceneGraph:
    return SceneGraph(made.task.layout)


def features(made: Setup, *parts: np.ndarray) -> np.ndarray:
    """Of corners, placed tokens and goals, (M, N, 4)."""
    tensors = (torch.from_numpy(np.asarray(part, np.float32)) for part in parts)
    rows = torch.zeros(len(parts[0]), dtype=torch.long)
    return graph_of(made).node_features(Scenes(*tensors, rows)).numpy()


@pytest.mark.parametrize("tokens", [SQUARE, PAIR])
def test_features_are_places_part_of_the_target_and_placed(tokens: dict[str, object]) -> None:
    """Sec. IV-A; nodes of the target always count as placed."""
    made = setup(tokens, agent=PAPER)
    batch, layout = random_transitions(made, 6), made.task.layout
    placed = np.random.default_rng(0).integers(0, 2, batch.placed.shape)
    found = features(made, batch.state, placed, batch.goal)
    nodes = [batch.state, layout.bases(batch.state), batch.goal]
    np.testing.assert_allclose(found[..., :2], np.concatenate(nodes, axis=1), atol=1e-6)
    own = np.arange(layout.nodes) < layout.corner_count + layout.tokens
    np.testing.assert_array_equal(found[..., 2], np.tile(~own, (6, 1)))
    flags = np.concatenate([placed[:, layout.token_of_corner], placed], axis=1)
    np.testing.assert_array_equal(found[:, own, 3], flags)
    assert (found[:, ~own, 3] == 1.0).all()


def test_features_of_the_square() -> None:
    made = setup(SQUARE, agent=PAPER)
    poses = np.array([[[0.1, 0.2, 0.0]], [[-0.5, 0.3, np.pi / 2]]])
    corners, goal = made.task.layout.corners(poses)
    found = features(made, corners[None], np.array([[False]]), goal[None])
    expected = [  # x, y, part of the target, placed
        [-0.1, 0.0, 0, 0],
        [0.3, 0.0, 0, 0],
        [0.3, 0.4, 0, 0],
        [-0.1, 0.4, 0, 0],
        [0.1, 0.2, 0, 0],
        [-0.3, 0.1, 1, 1],
        [-0.3, 0.5, 1, 1],
        [-0.7, 0.5, 1, 1],
        [-0.7, 0.1, 1, 1],
    ]
    np.testing.assert_allclose(found[0], expected, atol=1e-6)


def test_constants_are_no_weights() -> None:
    graph = graph_of(setup(agent=PAPER))
    np.testing.assert_array_equal(graph.adjacency, setup().task.layout.adjacency)
    assert graph.state_dict() == {}
    assert list(graph.parameters()) == []
