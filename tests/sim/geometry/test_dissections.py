"""Filling outlines: what can be filled is, what cannot is searched through."""

import time
from itertools import product

import numpy as np
import pytest
import shapely
from shapely import Polygon

from tangram_core.arrays import Complex, Floats
from tangram_sim.config import SimConfig
from tangram_sim.geometry.areas import Area, straightened
from tangram_sim.geometry.dissections import Budget, Laid, Search, Tokens
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.connected import sample_connected
from tangram_vision.silhouettes.silhouettes import (
    covered,
    fill_outline,
    nearest_fill,
    overlap,
)
from tests.sim.builders import SEVEN, layout_of

pytestmark = pytest.mark.fast

LAYOUT = layout_of(*SEVEN, scale=1.0)


def convex_outlines(side: float) -> list[Complex]:
    """The 20 convex outlines that 16 equal right triangles with two equal sides can have.

    The seven tans consist of such triangles, and fill 13 of these outlines (Wang and Hsiung, 1942).

    Args:
        side: of a square of the same area.

    Returns:
        Corners (n,) as complex numbers, counter-clockwise.
    """
    found: dict[tuple[tuple[int, int], ...], Complex] = {}
    for width, height in product(range(1, 17), repeat=2):
        # A rectangle without a triangle at each of its corners.
        for a, b, c, d in product(range(min(width, height) + 1), repeat=4):
            fits = a + b <= width and c + d <= width and b + c <= height and a + d <= height
            if not fits or 2 * width * height - a * a - b * b - c * c - d * d != 16:
                continue
            z = np.array(
                [a, width - b, width + 1j * b, width + 1j * (height - c)]
                + [width - c + 1j * height, d + 1j * height, 1j * (height - d), 1j * a]
            )
            z = z[np.abs(z - np.roll(z, 1)) > 0.5]
            ahead, behind = np.roll(z, -1) - z, z - np.roll(z, 1)
            z = z[np.abs((behind.conj() * ahead).imag) > 0.5]
            image = np.conj(z[::-1])
            found.setdefault(min(*_readings(z), *_readings(image)), z * side / np.sqrt(8.0))
    return list(found.values())


def _readings(z: Complex) -> list[tuple[tuple[int, int], ...]]:
    """Squared sides and turns of an outline, begun at each of its corners."""
    ahead = np.roll(z, -1) - z
    turns = np.degrees(np.angle(ahead / np.roll(ahead, 1)))
    sides = [
        (round(float(abs(way) ** 2)), round(float(turn)))
        for way, turn in zip(ahead, turns, strict=True)
    ]
    return [(*sides[i:], *sides[:i]) for i in range(len(sides))]


def polygon(points: Floats) -> Polygon:
    return Polygon(np.column_stack([points.real, points.imag]))


def whole(poses: Floats, mirrored: bool = False, layout: Layout = LAYOUT) -> Area:
    """What tokens cover, or the mirror image of that."""
    sides = np.zeros(layout.tokens, np.bool_)
    if mirrored:
        poses, sides = layout.mirrored(poses, sides)
    outlines = [layout.corners(poses, sides)[layout.corners_of(k)] for k in range(layout.tokens)]
    return shapely.union_all([Polygon(one) for one in outlines], grid_size=1e-9)


def gluing(seed: int) -> Floats:
    return sample_connected(LAYOUT, SimConfig(arena=4.0), np.random.default_rng(seed))


@pytest.mark.check
def test_thirteen_of_the_twenty_convex_outlines_are_filled_and_seven_searched_through(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Wang and Hsiung, 1942: a proof by hand of what the complete search finds."""
    # No best attempt is asked for.
    monkeypatch.setattr("tangram_vision.silhouettes.silhouettes._LOOSE", ())
    every = convex_outlines(1.0)
    assert len(every) == 20
    assert all(polygon(z).area == pytest.approx(1.0) for z in every)
    filled = [fill_outline(polygon(z * np.exp(0.3j)), LAYOUT, 60.0) for z in every]
    assert sum(one.found is not None for one in filled) == 13
    assert [one.complete for one in filled if one.found is None] == [True] * 7


@pytest.mark.parametrize("seed", range(12))
def test_random_gluings_are_filled_at_any_angle(seed: int) -> None:
    area = whole(gluing(seed), mirrored=seed % 2 == 1)
    filled = fill_outline(area, LAYOUT, 30.0)
    assert filled.found is not None
    assert filled.iou == pytest.approx(overlap(covered(LAYOUT, filled.found), area))
    assert filled.iou > 0.999
    assert filled.nodes >= 7


def test_parts_that_meet_in_a_corner_holes_and_angles_off_the_grid_are_filled() -> None:
    """A ring of tans around a hole, and one tan that touches it in a corner, turned freely."""
    poses = gluing(3)
    corners = LAYOUT.corners(poses)
    tip = corners[int(corners[:, 0].argmax())]
    square = SEVEN.index("square")
    poses[square] = (*(tip + 0.25 * np.array([np.cos(0.2), np.sin(0.2)])), 0.2)
    area = whole(poses)
    filled = fill_outline(area, LAYOUT, 30.0)
    assert filled.found is not None
    assert filled.iou > 0.99


def test_a_budget_ends_the_search_and_nothing_is_claimed() -> None:
    strip = polygon(np.array([0.0, 4.0, 4.0 + 0.25j, 0.25j]))
    filled = fill_outline(strip, LAYOUT, 30.0)
    assert (filled.found, filled.complete) == (None, True)
    unfilled = convex_outlines(1.0)[-1]
    budget = Budget(time.thread_time() + 30.0, nodes=3)
    assert list(Search(Tokens(LAYOUT), 0.004, budget).run(polygon(unfilled))) == []
    assert budget.spent()
    late = fill_outline(polygon(unfilled), LAYOUT, 0.0)
    assert (late.found, late.complete) == (None, False)


def test_an_area_that_is_not_that_of_the_tokens_is_left_at_once() -> None:
    filled = fill_outline(whole(gluing(0)).buffer(0.05, join_style="mitre"), LAYOUT, 30.0)
    assert (filled.found, filled.complete) == (None, True)
    assert filled.nodes < 20


def test_a_corner_that_no_tokens_make_ends_the_search_at_once() -> None:
    side, way = (2.0 / np.sqrt(3.0)) ** 0.5, np.exp(1j * np.pi / 3.0)
    rhombus = side * np.array([0.0, 1.0, 1.0 + way, way])  # 60 degrees, and the tokens' area
    budget = Budget(time.thread_time() + 30.0)
    assert list(Search(Tokens(LAYOUT), 0.004, budget).run(polygon(rhombus))) == []
    assert budget.taken == 1


def test_corners_of_tokens_are_told_once_for_each_turn_that_looks_alike() -> None:
    tokens = Tokens(LAYOUT)
    assert tokens.counts == (2, 1, 2, 1, 1)
    assert len(tokens.corners) == 14
    assert np.degrees(tokens.angles).round() == pytest.approx([45, 90, 90, 135, 135, 180, 180, 180])
    assert tokens.unit == pytest.approx(1.0)


def test_corners_within_a_side_are_none() -> None:
    ring = np.array([0.0, 0.5 + 0.001j, 1.0, 1.0 + 1e-4j, 1.0 + 1.0j, 1.0j])
    assert straightened(ring, 0.004) == pytest.approx(
        [0.0, 1.0 + 1e-4j, 1.0 + 1.0j, 1.0j], abs=2e-4
    )


def test_what_nothing_fills_keeps_the_tokens_that_could_be_laid() -> None:
    """Three tans fit into a strip as high as a small triangle, and a fourth may stand over."""
    strip = polygon(np.array([0.0, 4.0, 4.0 + 0.25j, 0.25j]))
    filled = fill_outline(strip, LAYOUT, 30.0)
    assert (filled.found, filled.complete) == (None, True)
    assert filled.attempt is not None
    laid = covered(LAYOUT, filled.attempt)
    assert 3 <= len(filled.attempt.laid) < 7
    assert filled.iou == pytest.approx(overlap(laid, strip))
    assert 0.24 < filled.iou < 0.4
    assert laid.difference(strip).area < 0.1 * laid.area
    late = fill_outline(strip, LAYOUT, 0.0)
    assert (late.attempt, late.iou) == (None, 0.0)


def test_a_search_remembers_the_most_that_it_laid() -> None:
    search = Search(Tokens(LAYOUT), 0.004, Budget(time.thread_time() + 30.0))
    assert list(search.run(polygon(convex_outlines(1.0)[-1]))) == []
    assert 0 < len(search.best) < 7
    laid = next(search.run(whole(gluing(1))))
    assert search.best == laid


def test_tokens_that_lie_on_each_other_are_no_better_attempt() -> None:
    """Two large triangles, one all but on the other, cover a little more than one alone."""
    tokens, side = Tokens(LAYOUT), polygon(np.array([0.0, 1.0, 1.0 + 1.0j, 1.0j]) - 0.5 - 0.5j)
    large = int(tokens.areas.argmax())
    one = [Laid(large, False, np.zeros(3))]
    two = [*one, Laid(large, False, np.array([0.05, 0.0, 0.0]))]
    for tried in ([one, two], [two, one]):
        found, iou = nearest_fill(side, LAYOUT, Budget(0.0), tried)
        assert found is not None
        assert len(found.laid) == 1
        assert iou == pytest.approx(0.25, abs=0.01)
    both, more = nearest_fill(side, LAYOUT, Budget(0.0), [two])
    assert both is not None
    assert more > 0.26
