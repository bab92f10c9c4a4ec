"""Targets that hang together: one piece, edge to edge, inside the arena, mirrored or not."""

import numpy as np
import pytest
import shapely

from tangram_sim.config import SimConfig
from tangram_sim.connected import sample_connected
from tangram_sim.errors import SamplingError
from tangram_sim.layout import Layout
from tangram_sim.seeding import evaluation_generators
from tests.sim.builders import LOPSIDED, SEVEN, largest_overlap, layout_of, pieces

pytestmark = pytest.mark.fast

GAME = layout_of(*SEVEN, scale=0.6)
LAYOUTS = [
    (GAME, 2.0),
    (layout_of("square", "square", scale=0.8), 1.0),
    (layout_of("parallelogram", LOPSIDED, "large_triangle", scale=0.25), 2.0),
    (layout_of(*SEVEN, scale=0.003), 0.01),
]


def shared_edge(one: shapely.Polygon, other: shapely.Polygon, tolerance: float) -> float:
    """Length of the outline of one that lies on the other."""
    return float(one.exterior.intersection(other.buffer(tolerance)).length)


@pytest.mark.parametrize(("layout", "arena"), LAYOUTS)
def test_each_piece_shares_an_edge_and_overlaps_none(layout: Layout, arena: float) -> None:
    sim = SimConfig(arena=arena)
    for rng in evaluation_generators(30):
        poses = sample_connected(layout, sim, rng)
        own = pieces(layout, poses)
        assert np.abs(layout.corners(poses)).max() <= arena / 2.0 + 1e-12
        assert np.abs(poses[:, 2]).max() <= np.pi
        assert largest_overlap(layout, poses) < 1e-8 * arena**2
        small = 1e-6 * arena
        union = shapely.union_all([piece.buffer(small) for piece in own])
        assert isinstance(union, shapely.Polygon)
        for k, piece in enumerate(own):
            others = [shared_edge(piece, other, small) for j, other in enumerate(own) if j != k]
            # More than what the buffer gives at a corner.
            assert max(others) > 100.0 * small


def test_every_piece_and_every_side_has_its_turn() -> None:
    """The layouts differ, are turned by any angle and lie anywhere they fit."""
    poses = np.stack([sample_connected(GAME, SimConfig(), r) for r in evaluation_generators(200)])
    counts, _ = np.histogram(poses[:, 0, 2], bins=4, range=(-np.pi, np.pi))
    assert counts.min() > 20
    assert np.abs(poses[..., :2].mean(axis=(0, 1))).max() < 0.1
    corners = GAME.corners(poses)
    assert corners.max(axis=(1, 2)).max() > 0.95
    assert np.ptp(corners, axis=1).max(axis=1).std() > 0.05


def test_the_same_generator_gives_the_same_target() -> None:
    once = [sample_connected(GAME, SimConfig(), rng) for rng in evaluation_generators(5)]
    again = [sample_connected(GAME, SimConfig(), rng) for rng in evaluation_generators(5)]
    np.testing.assert_array_equal(once, again)
    assert len(np.unique(np.round(once, 9).reshape(5, -1), axis=0)) == 5


def test_many_pieces_meet_corner_to_corner() -> None:
    """Seven of ten are laid so: of two squares one whole side is then shared."""
    layout, whole = layout_of("square", "square", scale=0.8), 0
    side = 0.8 * 2.0**0.5 / 4.0
    for rng in evaluation_generators(200):
        poses = sample_connected(layout, SimConfig(), rng)
        whole += abs(np.linalg.norm(poses[0, :2] - poses[1, :2]) - side) < 1e-9
    assert whole / 200 == pytest.approx(0.7, abs=0.12)


def test_no_room_is_told() -> None:
    with pytest.raises(SamplingError, match="does not fit into an arena of width 0.5"):
        sample_connected(layout_of("square", scale=2.0), SimConfig(arena=0.5), _rng())
    pair, sim = layout_of("square", "square", scale=1.0), SimConfig(arena=0.55, max_tries=64)
    with pytest.raises(SamplingError, match="no connected target .* 0.55 in 64 tries: raise"):
        sample_connected(pair, sim, _rng())
    sample_connected(pair, SimConfig(arena=0.85), _rng())


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)
