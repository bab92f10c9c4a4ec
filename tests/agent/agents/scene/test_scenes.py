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


@pytest.mark.parametrize("tokens", [SQUARE, PAIR])
def test_paper_features_equal_those_of_the_layout(tokens: dict[str, object]) -> None:
    made = setup(tokens, agent=PAPER)
    batch = random_transitions(made, 6)
    placed = np.random.default_rng(0).integers(0, 2, batch.placed.shape)
    parts = (np.asarray(part, np.float32) for part in (batch.state, placed, batch.goal))
    found = graph_of(made).node_features(
        Scenes(*(torch.from_numpy(part) for part in parts), torch.zeros(6, dtype=torch.long))
    )
    expected = made.task.layout.node_features(batch.state, placed, batch.goal)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_constants_are_no_weights() -> None:
    graph = graph_of(setup(agent=PAPER))
    np.testing.assert_array_equal(graph.adjacency, setup().task.layout.adjacency)
    assert graph.state_dict() == {}
    assert list(graph.parameters()) == []
