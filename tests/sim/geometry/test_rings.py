"""Outlines as rows of corners: nothing is lost on the way, and no rows do harm."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from shapely import Polygon

from tangram_core.errors import ConfigError
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.areas import rings
from tangram_sim.geometry.dissections import Budget, Search, Tokens, dissection
from tangram_sim.geometry.rings import as_area, as_rows, covered_area
from tangram_sim.motion.actions import goal_rows
from tangram_sim.puzzles.figures import library
from tangram_sim.targets.targets import placement
from tests.sim.builders import SEVEN, layout_of, pieces

pytestmark = pytest.mark.fast

LAYOUT = layout_of(*SEVEN, scale=0.6)
SIM = SimConfig(backend="kinematic", observe="silhouette", starts="outside", allow_flip=True)
ROWS = goal_rows(LAYOUT, SIM)
FIGURES = {puzzle.name: placement(puzzle, LAYOUT) for puzzle in library("test", 0.6)}


def travelled(area: shapely.Geometry) -> shapely.Geometry:
    return as_area(as_rows(area, LAYOUT, ROWS).astype(np.float32))


@pytest.mark.parametrize("name", FIGURES)
def test_figures_with_holes_and_parts_travel_whole(name: str) -> None:
    poses, flipped = FIGURES[name]
    truth = shapely.union_all(
        [one.buffer(1e-3, join_style="mitre") for one in pieces(LAYOUT, poses, flipped)]
    )
    area = covered_area(LAYOUT.corners(poses, flipped), LAYOUT)
    assert area.area == pytest.approx(LAYOUT.areas.sum(), rel=0.01)
    assert shapely.symmetric_difference(travelled(area), area).area < 2e-3 * area.area
    assert shapely.symmetric_difference(area, truth).area < 0.05 * area.area
    holes = [len(part.interiors) for part in shapely.get_parts(area)]
    assert [len(p.interiors) for p in shapely.get_parts(travelled(area))] == holes


def test_a_square_is_its_four_corners_and_the_first_again() -> None:
    square = Polygon([(0, 0), (0.2, 0), (0.5, 0), (0.5, 0.5), (0, 0.5)])
    rows = as_rows(square, LAYOUT, 7)
    (z, part, outer), *more = rings(square, 1e-3)
    assert len(z) == 4
    assert (part, outer, more) == (0, True, [])
    assert rows.shape == (7, 2)
    assert (rows[4:] == rows[0]).all()
    assert as_area(rows).equals(Polygon([(0, 0), (0.5, 0), (0.5, 0.5), (0, 0.5)]))


def test_too_many_corners_are_refused() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 41)[:-1]
    disc = Polygon(np.column_stack([np.cos(angles), np.sin(angles)]))
    with pytest.raises(ConfigError, match="at most 30 corners, .* got 41"):
        as_rows(disc, LAYOUT, ROWS)


@settings(max_examples=200, deadline=None)
@given(arrays(np.float32, (ROWS, 2), elements=st.floats(-3, 3, width=16)))
def test_any_rows_give_some_area(rows: np.ndarray) -> None:
    area = as_area(rows)
    assert 0.0 <= area.area <= 36.0
    assert shapely.is_valid(area)


def test_pieces_do_not_show_in_what_is_observed() -> None:
    """Another dissection of the same outline gives the same rows: nothing else is told of it."""
    unit = float(np.sqrt(LAYOUT.areas.sum()))
    square = Polygon(
        [(-unit / 2, -unit / 2), (unit / 2, -unit / 2), (unit / 2, unit / 2), (-unit / 2, unit / 2)]
    )
    tokens = Tokens(LAYOUT)
    found = Search(tokens, 0.004 * unit, Budget(np.inf)).run(square)
    one, *_, other = [dissection(tokens, laid) for _, laid in zip(range(9), found, strict=False)]
    assert np.abs(one.poses - other.poses).max() > 0.1
    env = BatchedEnv(LAYOUT, SIM, RewardConfig(), 1, outlines=True)
    seen = []
    for laid in (one, other):
        env.reset([np.random.default_rng(0)], (laid.poses[None], laid.flipped[None]))
        seen.append(env.seen_goals[0].copy())
        assert env.seen_goals.shape == (1, ROWS, 2)
    env.close()
    same = shapely.symmetric_difference(as_area(seen[0]), as_area(seen[1])).area
    assert same < 1e-9
    assert {tuple(np.round(row, 6)) for row in seen[0]} == {
        tuple(np.round(row, 6)) for row in seen[1]
    }
