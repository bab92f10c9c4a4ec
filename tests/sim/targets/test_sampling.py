"""Streams of randomness, and layouts: apart or edge to edge, inside the arena, bounded."""

import itertools

import numpy as np
import pytest
import shapely

from tangram_core.errors import SamplingError
from tangram_core.seeding import episode_generator
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.connected import sample_connected
from tangram_sim.targets.sampling import sample_batch
from tests.sim.builders import (
    LOPSIDED,
    SEVEN,
    SQUARE_SCALE,
    TRIO,
    evaluation_generators,
    largest_overlap,
    layout_of,
    pieces,
    sample_poses,
)

pytestmark = pytest.mark.fast


def test_every_argument_gives_another_stream() -> None:
    """Also where a plain list of integers would be padded or joined to the same entropy."""
    values = (0, 1, 2**32, 2**64)
    keys = itertools.product(values, ("player", "evaluator"), values, values, values)
    draws = [episode_generator(*key).integers(2**63) for key in keys]
    assert len(set(draws)) == len(draws) == 2 * 4**4


def test_streams_do_not_change_between_versions() -> None:
    """A run that is resumed, and the test set, rely on it."""
    assert episode_generator(1, "player", 2, 3, 4).random() == 0.7262557940995327
    assert evaluation_generators(1)[0].random() == 0.3233672278778038


def test_a_small_test_set_is_the_beginning_of_a_large_one() -> None:
    small, large = ([rng.random() for rng in evaluation_generators(size)] for size in (3, 100))
    assert small == large[:3]
    assert len(set(large)) == 100


@pytest.mark.parametrize(
    ("layout", "arena"),
    [
        (layout_of("square"), 2.0),
        (layout_of(*TRIO, LOPSIDED, scale=0.2), 2.0),
        (layout_of(*SEVEN, scale=0.9), 2.0),  # a fifth of the arena is filled
        (layout_of(*SEVEN, scale=0.0003), 0.001),
    ],
)
def test_tokens_lie_inside_and_apart(layout: Layout, arena: float) -> None:
    poses = sample_batch(layout, SimConfig(arena=arena), evaluation_generators(40))
    assert poses.shape == (40, layout.tokens, 3)
    assert np.abs(layout.corners(poses)).max() <= arena / 2.0
    assert max(largest_overlap(layout, one) for one in poses) < 1e-7 * arena**2


@pytest.mark.parametrize("overhang", [False, True])
def test_positions_and_angles_are_uniform(overhang: bool) -> None:
    layout, sim = layout_of("square"), SimConfig(overhang=overhang)
    rng = np.random.default_rng(0)
    poses = sample_batch(layout, sim, [rng] * 20_000)[:, 0]
    reach = 1.0 if overhang else 1.0 - layout.shapes[0].radius
    for column, bound in zip(poses.T, (reach, reach, np.pi), strict=True):
        counts, _ = np.histogram(column, bins=10, range=(-bound, bound))
        assert counts.sum() == 20_000  # nothing outside
        # Expected 2000 each with a deviation of 42.
        assert np.abs(counts - 2000).max() < 5 * 42
    assert np.abs(np.corrcoef(poses.T) - np.eye(3)).max() < 0.04


def test_an_arena_that_is_too_small_is_refused() -> None:
    layout = layout_of("small_triangle", "square", scale=SQUARE_SCALE)
    sim = SimConfig(arena=0.5)
    with pytest.raises(SamplingError, match=r"arena to at least 0\.596, or lower tokens\.scale"):
        sample_poses(layout, sim, np.random.default_rng(0))
    # What the message says is enough for each token alone.
    sample_poses(layout_of("small_triangle"), SimConfig(arena=0.6), np.random.default_rng(0))


def test_tries_are_bounded_exactly_and_giving_up_names_the_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The last chunk is cut: 5 tries are 4 and 1, whatever the chunk."""
    monkeypatch.setattr("tangram_sim.targets.sampling.MAX_TRIES", 5)
    layout, sim = layout_of("square", "square"), SimConfig(arena=0.6)
    rng, twin = np.random.default_rng(0), np.random.default_rng(0)
    with pytest.raises(
        SamplingError, match=r"'square' beside 1 others in 5 tries .* 0\.6: raise sim\.arena"
    ):
        sample_poses(layout, sim, rng)
    twin.random((1 + 5, 3))
    assert rng.random() == twin.random()


def test_what_is_to_be_avoided_is_avoided_where_there_is_room() -> None:
    layout, sim = layout_of(*TRIO, scale=0.6), SimConfig()
    wall = np.array([[[-1.0, -1.0], [0.3, -1.0], [0.3, 1.0], [-1.0, 1.0]]])
    poses = sample_batch(layout, sim, evaluation_generators(30), avoid=np.tile(wall, (30, 1, 1, 1)))
    assert layout.corners(poses)[..., 0].min() > 0.3 - 1e-6
    everywhere = np.tile(wall * 9.0, (30, 1, 1, 1))
    poses = sample_batch(layout, sim, evaluation_generators(30), avoid=everywhere)
    assert layout.corners(poses)[..., 0].min() < -0.5


def test_avoiding_gives_up_after_its_own_tries() -> None:
    """64 of them, in chunks of 4, then as if there were nothing to avoid."""
    layout, sim = layout_of("square"), SimConfig()
    everywhere = np.array([[[[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]]]])
    rng, twin = np.random.default_rng(0), np.random.default_rng(0)
    poses = sample_batch(layout, sim, [rng], avoid=everywhere)
    twin.random((64, 3))
    np.testing.assert_array_equal(poses[0], sample_poses(layout, sim, twin))


GAME = layout_of(*SEVEN, scale=0.6)
LAYOUTS = [
    (GAME, 2.0),
    (layout_of("parallelogram", LOPSIDED, "large_triangle", scale=0.25), 2.0),
    (layout_of(*SEVEN, scale=0.003), 0.01),
]


def shared_edge(one: shapely.Polygon, other: shapely.Polygon, tolerance: float) -> float:
    """Length of the outline of one that lies on the other."""
    return float(one.exterior.intersection(other.buffer(tolerance)).length)


@pytest.mark.parametrize(("layout", "arena"), LAYOUTS)
def test_each_piece_shares_an_edge_and_overlaps_none(layout: Layout, arena: float) -> None:
    sim = SimConfig(arena=arena)
    for rng in evaluation_generators(20):
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


def test_many_pieces_meet_corner_to_corner() -> None:
    """Seven of ten are laid so: of two squares one whole side is then shared."""
    layout, whole = layout_of("square", "square", scale=0.8), 0
    side = 0.8 * 2.0**0.5 / 4.0
    for rng in evaluation_generators(200):
        poses = sample_connected(layout, SimConfig(), rng)
        whole += abs(np.linalg.norm(poses[0, :2] - poses[1, :2]) - side) < 1e-9
    assert whole / 200 == pytest.approx(0.7, abs=0.12)


def test_no_room_is_told() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(SamplingError, match="does not fit into an arena of width 0.5"):
        sample_connected(layout_of("square", scale=2.0), SimConfig(arena=0.5), rng)
    pair, sim = layout_of("square", "square", scale=1.0), SimConfig(arena=0.55)
    with pytest.raises(SamplingError, match="no connected target .* 0.55 in 1000 tries: raise"):
        sample_connected(pair, sim, rng)
    sample_connected(pair, SimConfig(arena=0.85), rng)
