"""Features against the layout's own, and hand-made scenes."""

import math

import numpy as np
import pytest
import torch

from tangram_agent.scenes import SceneGraph, Scenes
from tangram_agent.setup import Setup
from tangram_sim.layout import Layout
from tests.agent.builders import PAIR, PAPER, SQUARE, random_transitions, setup

pytestmark = pytest.mark.fast

NO_TOKEN = torch.zeros(1, dtype=torch.long)


def graph_of(made: Setup) -> SceneGraph:
    return SceneGraph(made.layout, made.sim.arena, made.agent)


def corners(layout: Layout, *poses: tuple[float, float, float]) -> torch.Tensor:
    return torch.from_numpy(layout.corners(np.array([poses]))).float()


@pytest.mark.parametrize("tokens", [SQUARE, PAIR])
def test_paper_features_equal_those_of_the_layout(tokens: dict[str, object]) -> None:
    made = setup(tokens, agent=PAPER)
    batch = random_transitions(made, 6)
    placed = np.random.default_rng(0).integers(0, 2, batch.placed.shape)
    parts = (np.asarray(part, np.float32) for part in (batch.state, placed, batch.goal))
    found = graph_of(made).node_features(
        Scenes(*(torch.from_numpy(part) for part in parts), torch.zeros(6, dtype=torch.long))
    )
    expected = made.layout.node_features(batch.state, placed, batch.goal)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_a_perceptron_is_told_the_edges_as_a_matrix_beside_the_features() -> None:
    """Nine nodes of a square have 4 features and 9 entries each: 117 numbers."""
    made = setup(agent={**PAPER, "edges": "inputs"}, net={"kind": "mlp"})
    batch, graph = random_transitions(made, 6), graph_of(made)
    parts = (torch.from_numpy(np.asarray(p, np.float32)) for p in (batch.state, batch.placed))
    goal = torch.from_numpy(np.asarray(batch.goal, np.float32))
    scenes = Scenes(*parts, goal, torch.zeros(6, dtype=torch.long))
    seen = graph.vectors(scenes)
    assert (graph.inputs, seen.shape) == (117, (6, 117))
    assert torch.equal(seen[:, :36], graph.node_features(scenes).flatten(1))
    edges = torch.from_numpy(made.layout.adjacency).float().flatten()
    assert torch.equal(seen[:, 36:], edges.expand(6, -1))


def test_offsets_are_corner_directions_of_every_piece() -> None:
    """The square's corners lie on the diagonals; its base has no offset."""
    made = setup(agent={**PAPER, "offsets": True})
    scene = corners(made.layout, (0.3, -0.2, 0.0)), corners(made.layout, (-0.5, 0.1, math.pi / 4))
    features = graph_of(made).node_features(Scenes(scene[0], torch.zeros(1, 1), scene[1], NO_TOKEN))
    half = math.sqrt(0.5)
    expected = [
        *([-half, -half], [half, -half], [half, half], [-half, half]),
        [0, 0],
        *([0, -1], [1, 0], [0, 1], [-1, 0]),
    ]
    np.testing.assert_allclose(features[0, :, 4:6].numpy(), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "symmetry"), [("square", 4), ("parallelogram", 2), ("large_triangle", 1)]
)
def test_orientation_is_k_times_the_angle_to_the_token(shape: str, symmetry: int) -> None:
    made = setup({"shapes": [shape], "scale": 1}, agent={**PAPER, "orientation": True})
    scene = corners(made.layout, (0, 0, 0.5)), corners(made.layout, (1, 0, 0.8))
    features = graph_of(made).node_features(Scenes(scene[0], torch.zeros(1, 1), scene[1], NO_TOKEN))
    count = made.layout.corner_count
    angle = 0.3 * symmetry
    expected = np.array([[1.0, 0.0]] * (count + 1) + [[math.cos(angle), math.sin(angle)]] * count)
    np.testing.assert_allclose(features[0, :, 4:6].numpy(), expected, atol=1e-5)


def test_the_egocentric_frame_is_the_moving_tokens() -> None:
    made = setup(PAIR, agent={**PAPER, "egocentric": True})
    layout = made.layout
    scene = corners(layout, (0.3, 0.1, 0.4), (-0.6, 0.2, -1.0))
    goal = corners(layout, (0.0, 0.5, 2.0), (0.4, -0.3, 0.1))
    second = torch.tensor([1])
    features = graph_of(made).node_features(Scenes(scene, torch.zeros(1, 2), goal, second))[0]
    own = layout.corners_of(1)
    np.testing.assert_allclose(features[own, :2].numpy(), layout.body[own], atol=1e-6)
    cos, sin = math.cos(1.0), math.sin(1.0)
    point = goal[0, 0].numpy() - [-0.6, 0.2]
    expected = [cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]]
    first_goal_node = layout.corner_count + layout.tokens
    np.testing.assert_allclose(features[first_goal_node, :2].numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("velocity", [(0.2, -0.3, 0.0), (0.0, 0.0, 1.0), (-0.4, 0.1, -0.35)])
def test_move_is_the_rigid_motion_of_the_simulation(velocity: tuple[float, float, float]) -> None:
    made = setup(PAIR)
    layout, poses = made.layout, np.array([[0.3, 0.1, 0.4], [-0.6, 0.2, -1.0]])
    start = corners(layout, *map(tuple, poses))
    scene = Scenes(start, torch.zeros(1, 2), start, torch.tensor([1]))
    moved = graph_of(made).moved(scene, torch.tensor([velocity])).corners
    poses[1] += np.array(velocity) * [2.0, 2.0, math.pi]
    np.testing.assert_allclose(moved[0].numpy(), layout.corners(poses), atol=1e-6)


def test_frames_of_world_and_token_are_inverse() -> None:
    made = setup()
    graph = graph_of(made)
    state = torch.from_numpy(random_transitions(made, 8).state)
    scenes = Scenes(state, torch.zeros(8, 1), state, torch.zeros(8, dtype=torch.long))
    seen = torch.rand(8, 3, generator=torch.Generator().manual_seed(0)) / 2.0
    there = graph.velocity(scenes, seen[:, :2], seen[:, 2])
    assert (there - seen)[:, :2].abs().max() > 0.1
    torch.testing.assert_close(graph.as_seen(scenes, there), seen)


def test_constants_are_no_weights() -> None:
    graph = graph_of(setup())
    assert graph.state_dict() == {}
    assert list(graph.parameters()) == []


@pytest.mark.parametrize("tokens", [SQUARE, PAIR])
def test_edges_are_the_papers_or_all(tokens: dict[str, object]) -> None:
    paper, complete = (graph_of(setup(tokens, agent={"edges": e})) for e in ("paper", "complete"))
    layout = setup(tokens).layout
    np.testing.assert_array_equal(paper.adjacency, layout.adjacency)
    np.testing.assert_array_equal(complete.adjacency, ~np.eye(layout.nodes, dtype=bool))


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.9])
@pytest.mark.parametrize("flipped", [False, True])
def test_the_heading_of_a_token_on_either_side_is_its_turn(angle: float, flipped: bool) -> None:
    made = setup({"shapes": ["square", "parallelogram"], "scale": 1}, agent={"readout": "token"})
    poses = np.array([[0.3, 0.1, -0.4], [-0.2, 0.5, angle]])
    scene = made.layout.corners(poses, np.array([False, flipped]))
    points = torch.from_numpy(scene[None]).float()
    graph = graph_of(made)
    found = graph.headings(points, graph.centres(points))[0]
    expected = [[math.cos(a), math.sin(a)] for a in (-0.4, angle)]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_noise_turns_no_token_over_that_has_one_side() -> None:
    kite = {"name": "kite", "corners": [[-4, 0], [0, -0.2], [5, 0], [0, 0.2]]}
    made = setup({"shapes": [kite, "parallelogram"], "scale": 0.1}, agent={"readout": "token"})
    rng = np.random.default_rng(0)
    scene = made.layout.corners(rng.uniform(-1.0, 1.0, (200, 2, 3)))
    scene += 0.02 * rng.standard_normal(scene.shape)
    points = torch.from_numpy(scene).float()
    graph = graph_of(made)
    found = graph.headings(points, graph.centres(points))[:, 0]
    angle = made.layout.poses(scene)[:, 0, 2]
    expected = np.column_stack([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(found, expected, atol=1e-4)
