"""What a token sees of a piece: the same wherever the scene lies, and the layout's own corners."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from tangram_agent.agents.pair.pairs import PairGraph, Pairs
from tangram_sim.geometry.fitting import KINDS
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tests.agent.agents.pair.pair_scenes import SEVEN, every_pair, random_pairs, random_scene

pytestmark = pytest.mark.fast

LAYOUT = make_layout(TokensConfig(**SEVEN))
GRAPH = PairGraph(LAYOUT, 2.0)
SEEDS = range(3)
PARALLELOGRAM, SQUARE, TRIANGLE = 6, 5, 0
MIRROR = np.array([shape.mirror or 0.0 for shape in LAYOUT.shapes])


def layout_of(*shapes: Any) -> Layout:
    return make_layout(TokensConfig(shapes, 0.6))


def scene_pairs(seed: int, change: Any = None) -> Pairs:
    """All pairs of a random scene, both of whose halves are changed."""
    rng = np.random.default_rng(seed)
    halves = [random_scene(LAYOUT, rng) for _ in range(2)]
    own, goals = (change(*half) if change else half for half in halves)
    return every_pair(*own, *goals)


def one_pair(
    token: int, piece: int, pose: Any, goal: Any, flipped: float = 0.0, goal_flipped: float = 0.0
) -> Pairs:
    return Pairs(
        pose=torch.tensor([pose]).float(),
        flipped=torch.tensor([flipped]),
        token=torch.tensor([token]),
        goal=torch.tensor([goal]).float(),
        goal_flipped=torch.tensor([goal_flipped]),
        piece=torch.tensor([piece]),
        covered=torch.zeros(1),
    )


def same_views(one: Pairs, other: Pairs, where: Any = slice(None)) -> None:
    np.testing.assert_allclose(
        GRAPH.node_features(one)[where], GRAPH.node_features(other)[where], atol=2e-5
    )
    np.testing.assert_allclose(GRAPH.vectors(one)[where], GRAPH.vectors(other)[where], atol=2e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_rigid_motion_of_the_whole_scene_changes_nothing(seed: int) -> None:
    def turned(poses: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        centres = (poses[:, :2] @ (1.0, 1j)) * np.exp(0.7j * (seed + 1)) + 0.4 - 0.3j
        return np.column_stack([centres.real, centres.imag, poses[:, 2] + 0.7 * (seed + 1)]), sides

    same_views(scene_pairs(seed), scene_pairs(seed, turned))


@pytest.mark.parametrize("seed", SEEDS)
def test_what_tokens_see_of_a_mirrored_scene(seed: int) -> None:
    """Those with two sides the scene itself. One whose mirror image is itself, turned, sees the
    mirror image, by so much less turned.
    """
    plain, image = scene_pairs(seed), scene_pairs(seed, LAYOUT.mirrored)
    chiral = plain.token == PARALLELOGRAM
    assert chiral.sum() == 7
    same_views(plain, image, chiral)
    place, seen = (GRAPH.relation(pairs)[0].numpy() @ (1.0, 1j) for pairs in (plain, image))
    expected = place.conj() * np.exp(-1j * MIRROR[plain.token])
    np.testing.assert_allclose(seen[~chiral], expected[~chiral], atol=1e-5)


def moved(pairs: Pairs, shift: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Poses after a shift in arena units and a turn in radians as the tokens see them."""
    velocity = GRAPH.velocity(pairs, shift / 2.0, angle / math.pi)
    return GRAPH.moved(pairs, velocity).pose


def same_poses(found: torch.Tensor, expected: torch.Tensor) -> None:
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-5)
    np.testing.assert_allclose(np.exp(1j * (found - expected)[:, 2].numpy()), 1.0, atol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_moved_is_the_inverse_of_way(seed: int) -> None:
    pairs, other = random_pairs(LAYOUT, seed), random_pairs(LAYOUT, seed + 100)
    way = GRAPH.way(pairs, other.pose)
    assert way[:, 2].abs().max() <= 1.0
    same_poses(GRAPH.moved(pairs, way).pose, other.pose)


def test_no_motion_goes_further_than_an_action_can() -> None:
    pairs = one_pair(0, 0, (0.1, 0.2, math.pi / 2), (0.0, 0.0, 0.0))
    found = moved(pairs, torch.tensor([[0.5, 3.0]]), torch.tensor([0.25]))
    np.testing.assert_allclose(found, [[0.1 - 2.0, 0.2 + 0.5, math.pi / 2 + 0.25]], atol=1e-6)


@pytest.mark.parametrize(
    ("flipped", "goal_flipped", "expected"),
    [
        # The piece is 0.3 ahead and 0.1 to the left of a token that looks along y, turned by 0.5.
        (0.0, 0.0, (0.3, 0.1, 0.5, 0.0)),
        (0.0, 1.0, (0.3, 0.1, 0.5, 1.0)),
        (1.0, 0.0, (0.3, -0.1, -0.5, 1.0)),
        (1.0, 1.0, (0.3, -0.1, -0.5, 0.0)),
    ],
)
def test_the_relation_of_two_parallelograms(
    flipped: float, goal_flipped: float, expected: tuple[float, ...]
) -> None:
    pose, goal = (0.2, 0.4, math.pi / 2), (0.1, 0.7, math.pi / 2 + 0.5)
    pairs = one_pair(PARALLELOGRAM, PARALLELOGRAM, pose, goal, flipped, goal_flipped)
    place, angle, other_side = GRAPH.relation(pairs)
    found = [*place[0].tolist(), angle.item(), other_side.item()]
    assert found == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("token", range(7))
@pytest.mark.parametrize("flipped", [0.0, 1.0])
def test_a_token_on_its_piece_sees_it_at_no_place_and_no_angle(token: int, flipped: float) -> None:
    side = flipped * float(LAYOUT.chiral[token])
    symmetry = LAYOUT.shapes[token].symmetry
    for turns in range(symmetry):
        goal = (0.3, -0.2, 0.7 + 2.0 * math.pi * turns / symmetry)
        pairs = one_pair(token, token, (0.3, -0.2, 0.7), goal, side, side)
        place, angle, other_side = GRAPH.relation(pairs)
        assert place.abs().max() < 1e-6
        assert np.exp(1j * symmetry * angle.item()) == pytest.approx(1.0, abs=1e-5)
        assert other_side.item() == 0.0


def same_points(found: np.ndarray, expected: np.ndarray) -> None:
    """Each point of one set is one of the other."""
    gap = np.abs(found[:, None] - expected)
    assert max(gap.min(axis=0).max(), gap.min(axis=1).max()) < 1e-5


@pytest.mark.parametrize("seed", SEEDS)
def test_nodes_lie_at_the_corners_that_the_layout_gives(seed: int) -> None:
    """In the token's frame, straight from its definition."""
    rng = np.random.default_rng(seed)
    (own, sides), (goals, goal_sides) = random_scene(LAYOUT, rng), random_scene(LAYOUT, rng)
    pairs = every_pair(own, sides, goals, goal_sides)
    nodes = GRAPH.node_features(pairs).numpy()
    mine, corners = LAYOUT.corners(own, sides), LAYOUT.corners(goals, goal_sides)

    def seen(points: np.ndarray, token: int) -> np.ndarray:
        away = ((points - own[token, :2]) @ (1.0, 1j)) * np.exp(-1j * own[token, 2])
        return away.conj() if sides[token] else away

    for i, (token, piece) in enumerate(
        zip(pairs.token.tolist(), pairs.piece.tolist(), strict=True)
    ):
        points = nodes[i, :, :2] @ (1.0, 1j)
        same_points(points[:4], seen(mine[LAYOUT.corners_of(token)], token))
        same_points(points[5:], seen(corners[LAYOUT.corners_of(piece)], token))
        offsets = nodes[i, 5:, 2:4] @ (1.0, 1j) * LAYOUT.shapes[token].radius
        expected = points[5:] - seen(goals[piece, None, :2], token)
        np.testing.assert_allclose(offsets, expected, atol=1e-5)
        np.testing.assert_allclose(points[4], seen(own[token, None, :2], token)[0], atol=1e-6)
        assert nodes[i, 4, 2:4].tolist() == [0.0, 0.0]
    assert (nodes[..., 4] == [0, 0, 0, 0, 0, 1, 1, 1, 1]).all()


def test_the_numbers_of_a_pair_without_nodes() -> None:
    """Two squares of side 1, the piece at (1, 0) and turned by 0.2, a third of it covered."""
    side = layout_of("square").shapes[0].corners
    layout = make_layout(TokensConfig(("square",), 1.0 / np.ptp(side[:, 0]) * 0.6))
    pairs = one_pair(0, 0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.2))
    pairs.covered[:] = 1 / 3
    found = PairGraph(layout, 2.0).vectors(pairs)[0].numpy()
    radius = math.sqrt(0.5)
    body = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    corners = (body @ (1.0, 1j)) * np.exp(0.2j) + 1.0
    kind = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    expected = [
        *(1.0, 0.0),
        *(math.cos(0.8), math.sin(0.8), math.cos(0.2), math.sin(0.2), math.exp(-0.2)),
        *(np.column_stack([corners.real, corners.imag]).ravel() * 0.3 / radius),
        *(body.ravel() / radius),
        *kind,
        *kind,
        *(0.0, 1 / 3, 0.0, math.exp(-1.0 / radius)),
    ]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_what_all_nodes_of_a_pair_are_told() -> None:
    """A small triangle and, a fifth away, a square of twice its area; nine tenths are covered."""
    pairs = one_pair(3, SQUARE, (0.1, 0.1, 0.0), (0.3, 0.1, 0.1))
    near = math.exp(-0.2 / LAYOUT.shapes[3].radius)
    pairs.covered[:] = 0.9
    told = GRAPH.node_features(pairs)[0, :, 5:].numpy()
    expected = [
        *(math.cos(0.4), math.sin(0.4), math.cos(0.1), math.sin(0.1), math.exp(-0.1)),
        *(0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
        *(math.log(2.0), near, 0.9, 0.0),
    ]
    np.testing.assert_allclose(told, np.broadcast_to(expected, told.shape), atol=1e-6)


@pytest.mark.parametrize(
    ("piece", "angle", "off"),
    [
        (SQUARE, 0.0, 0.0),
        (SQUARE, math.pi / 2 - 0.1, 0.1),
        (SQUARE, -math.pi / 4, math.pi / 4),
        (SQUARE, 3 * math.pi + 0.2, 0.2),
        (PARALLELOGRAM, math.pi - 0.3, 0.3),
        (TRIANGLE, math.pi - 0.3, math.pi - 0.3),
    ],
)
def test_a_pair_tells_how_aligned_it_is_with_a_cusp_where_it_is(
    piece: int, angle: float, off: float
) -> None:
    pairs = one_pair(piece, piece, (0.0, 0.0, 0.0), (0.0, 0.0, angle))
    aligned = GRAPH.node_features(pairs)[0, 0, 9].item()
    assert aligned == pytest.approx(math.exp(-off), abs=1e-5)


@pytest.mark.parametrize(
    ("shape", "number"),
    [
        *((name, i) for i, name in enumerate(KINDS)),
        ("parallelogram_mirrored", 4),
        ({"name": "kite", "corners": [[0, 0], [2, -1], [3, 0], [2, 1]]}, 5),
    ],
)
def test_a_tan_has_its_number_in_every_set(shape: Any, number: int) -> None:
    graph = PairGraph(layout_of("square", shape), 2.0)
    assert graph.kind[1].argmax() == number
    assert graph.kind.sum(dim=1).tolist() == [1.0, 1.0]


def test_edges_are_those_of_the_paper() -> None:
    """Three corners of the token, its base, three of the piece."""
    rows = ["0111000", "1011000", "1101000", "1110111", "0001011", "0001101", "0001110"]
    found = PairGraph(layout_of("small_triangle"), 2.0).adjacency.int().tolist()
    assert ["".join(map(str, row)) for row in found] == rows
