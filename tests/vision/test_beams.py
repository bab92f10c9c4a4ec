"""A beam lays tokens in outlines of which corners are wrong or lost."""

import time

import numpy as np
import pytest
import shapely
from shapely import Polygon

from tangram_sim.config import SimConfig
from tangram_sim.geometry.areas import Area, overlap
from tangram_sim.geometry.dissections import Budget, Dissection, Search, Tokens, dissection
from tangram_sim.targets.connected import sample_connected
from tangram_vision.silhouettes.beams import Beam, State
from tangram_vision.silhouettes.silhouettes import covered
from tests.sim.builders import SEVEN, layout_of

pytestmark = pytest.mark.slow

LAYOUT = layout_of(*SEVEN, scale=1.0)
TOKENS = Tokens(LAYOUT)
SQUARE = Polygon([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def gluing(seed: int) -> Area:
    poses = sample_connected(LAYOUT, SimConfig(arena=3.3), np.random.default_rng(seed))
    return covered(LAYOUT, Dissection(poses, np.zeros(7, np.bool_)))


def cut(area: Area, size: float = 0.08) -> Area:
    """Without the first convex corner, along a line that no tan has a side on."""
    z = np.asarray(shapely.get_parts(shapely.normalize(area))[0].exterior.coords)[:-1] @ (1.0, 1j)
    hull = np.asarray(area.convex_hull.exterior.coords)[:-1] @ (1.0, 1j)
    i = int(np.flatnonzero(np.isin(np.round(z, 9), np.round(hull, 9)))[0])
    ahead, behind = z[(i + 1) % len(z)] - z[i], z[i - 1] - z[i]
    off = (z[i] + size * ahead / abs(ahead), z[i] + 0.4 * size * behind / abs(behind))
    return shapely.difference(area, Polygon([(p.real, p.imag) for p in (z[i], *off)]))


def beam(area: Area, width: int = 12, tolerance: float = 0.035) -> list[State]:
    return Beam(TOKENS, width).run(
        area, TOKENS.counts, tolerance, Budget(time.thread_time() + 60.0)
    )


def test_outlines_that_lost_a_corner_are_filled() -> None:
    """No search fills one, whatever its tolerance: tokens have no corner there."""
    filled = 0
    for seed in range(6):
        whole = gluing(seed)
        rough = cut(whole)
        exact = Search(TOKENS, 0.014, Budget(time.thread_time() + 60.0))
        assert list(exact.run(rough)) == []
        best = beam(rough)[0]
        fits = overlap(covered(LAYOUT, dissection(TOKENS, best.laid)), whole) > 0.9
        filled += fits and not any(best.left)
    assert filled >= 5


def test_what_covers_most_by_least_comes_first() -> None:
    states = beam(gluing(1))
    uncovered = [float(TOKENS.areas @ state.left) + state.over for state in states]
    assert uncovered == sorted(uncovered)
    assert len(states) == 12


def test_a_token_that_reaches_out_is_worth_less() -> None:
    inside = State((), (1, 0, 0, 0, 0), SQUARE, 0.0)
    worth = Beam(TOKENS, 1)._worth([inside, inside._replace(over=TOKENS.areas.min())])
    assert worth[0] - worth[1] == pytest.approx(1.0)


def test_of_equals_the_largest_token_is_followed() -> None:
    first = TOKENS.own[beam(SQUARE, 1)[0].laid[0].shape][0]
    assert SEVEN[first] == "large_triangle"


def test_there_may_be_nothing_to_lay() -> None:
    assert beam(Polygon()) == []
    assert Beam(TOKENS, 12).run(SQUARE, TOKENS.counts, 0.035, Budget(0.0)) == []


def test_a_beam_ends_within_a_depth() -> None:
    """Of a rugged outline one depth can take seconds."""
    assert Beam(TOKENS, 12).run(SQUARE, TOKENS.counts, 0.035, Budget(np.inf, nodes=1)) == []


def test_a_wider_beam_fills_more() -> None:
    """A beam of one fills none of these."""
    filled = []
    for width in (1, 12):
        best = [beam(gluing(seed), width, tolerance=0.004)[0] for seed in (1, 6, 7)]
        filled.append(sum(not any(state.left) for state in best))
    assert filled[0] + 1 < filled[1]
