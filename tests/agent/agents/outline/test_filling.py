"""States of an outline: what is left, what may be laid, and how their corners look."""

import numpy as np
import pytest
import shapely
import torch
from shapely import Polygon

from tangram_agent.agents.outline.filling import UNUSED, Filling, Rests
from tangram_agent.agents.outline.values import Corners, OutlineValue, features
from tangram_sim.geometry.rings import as_rows, covered_area
from tests.agent.agents.outline.outlines import ALL, outline_setup

pytestmark = pytest.mark.fast

MADE = outline_setup()
FILLING = Filling(MADE.task.layout)
LEG = float(np.sqrt(2.0 * MADE.task.layout.areas[0]))  # of a small triangle
UNIT = float(np.sqrt(MADE.task.layout.areas.sum()))
SQUARE = Polygon([(0, 0), (LEG, 0), (LEG, LEG), (0, LEG)])
STRIP = Polygon([(0, 0), (4 * LEG, 0), (4 * LEG, LEG / 4), (0, LEG / 4)])


def turned(area: shapely.Geometry, angle: float, shift: complex) -> shapely.Geometry:
    def move(points: np.ndarray) -> np.ndarray:
        z = (points @ (1.0, 1j)) * np.exp(1j * angle) + shift
        return np.column_stack([z.real, z.imag])

    return shapely.transform(area, move)


def test_two_triangles_fill_their_square_in_two_ways() -> None:
    """The corner where least fits: along either diagonal, and the rest is the other triangle."""
    places = FILLING.places(SQUARE, (2,))
    assert len(places) == 2
    for place in places:
        assert place.left == (1,)
        assert not place.dead
        assert not place.filled
        assert place.rest.area == pytest.approx(SQUARE.area / 2.0, rel=1e-3)
        (last,) = FILLING.places(place.rest, place.left)
        assert last.filled
        assert last.left == (0,)


def test_a_strip_takes_no_token() -> None:
    assert FILLING.places(STRIP, (2,)) == []


def test_what_is_left_must_have_the_tokens_area() -> None:
    assert FILLING.places(SQUARE, (1,)) == []


def test_what_tokens_cover_is_taken_away() -> None:
    layout = MADE.task.layout
    poses = np.zeros((2, 3))
    corners = layout.corners(poses + [[0, 0, 0], [5, 5, 0]])
    goal = layout.corners(np.array([[0.0, 0, 0], [2 * LEG, 0, 0]]))
    outline = as_rows(covered_area(goal, layout), layout, MADE.task.goal_rows)
    laid = np.array([True, False])
    rest = FILLING.rest(outline, corners, laid)
    assert rest.area == pytest.approx(layout.areas[0], rel=1e-2)
    assert FILLING.inside(corners, outline).tolist() == [True, False]
    assert FILLING.left(~laid) == (1,)


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0, -1.1])
def test_a_state_looks_the_same_wherever_it_lies(angle: float) -> None:
    """The cut square has one longest side, which tells where it is seen from."""
    house = Polygon([(0, 0), (1.3, 0), (1, 0.4), (0.5, 0.9), (0, 0.4)])
    first, moved = FILLING.seen(house, (2,)), FILLING.seen(turned(house, angle, 3 - 1j), (2,))
    for name, column in vars(first).items():
        assert getattr(moved, name) == pytest.approx(column, abs=1e-5), name


def test_corners_follow_each_other_around_every_ring() -> None:
    ring = SQUARE.buffer(LEG, join_style="mitre").difference(SQUARE)
    seen = FILLING.seen(ring, (2,))
    if (seen.part[0] == UNUSED).all():  # eight corners are more than two triangles have
        seen = Filling(outline_setup(ALL, allow_flip=True).task.layout).seen(ring, (0,) * 5)
    used = np.flatnonzero(seen.part[0] != UNUSED)
    assert len(used) == 8
    for start in (used[0], used[4]):
        walk, at = [], int(start)
        for _ in range(4):
            walk.append(at)
            at = int(seen.follow[0, at])
        assert at == start
        assert len(set(walk)) == 4


def test_too_many_corners_are_not_seen() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 101)[:-1]
    star = (1.0 + 0.5 * (-1.0) ** np.arange(100)) * np.exp(1j * angles)
    seen = FILLING.seen(Polygon(np.column_stack([star.real, star.imag])), (2,))
    assert (seen.part == UNUSED).all()
    value = OutlineValue(FILLING.shapes, MADE.agent.net)
    with torch.no_grad():
        logits = value(Corners.of(Rests.joined([seen, FILLING.seen(SQUARE, (2,))])))
    assert logits.abs().max() < 10.0


def test_features_of_a_square() -> None:
    """Every corner: half a side from the middle, sides of one unit, a right angle, all its area."""
    side = UNIT  # the unit of what is seen
    square = Polygon([(0, 0), (side, 0), (side, side), (0, side)])
    longer = Polygon([(0, 0), (side, 0), (side, side), (side / 2, 2 * side), (0, side)])
    both = Rests.joined([FILLING.seen(one, (2,)) for one in (square, longer)])
    corners, unused = features(Corners.of(both))[0].split([4, 1])
    assert (unused == 0).all()
    assert corners[:, :2].abs() == pytest.approx(0.5, abs=1e-5)
    out, back, lengths = corners[:, 2:4], corners[:, 4:6], corners[:, 6:8]
    assert (out * back).sum(dim=1).abs().max() < 1e-5
    assert lengths == pytest.approx(1.0, abs=1e-5)
    cosine, sine, area, parts, used, left = corners[:, 8:].T
    assert cosine.abs().max() < 1e-5
    assert sine == pytest.approx(1.0, abs=1e-5)
    assert area == pytest.approx(1.0, abs=1e-5)
    assert parts == pytest.approx(1 / 3)
    assert used == pytest.approx(1.0)
    assert left == pytest.approx(1.0)


def test_a_value_does_not_depend_on_what_it_is_valued_with() -> None:
    """Rows without corners are masked: alone or beside a larger state, it is the same."""
    made = outline_setup(ALL)
    filling = Filling(made.task.layout)
    big = covered_area(
        made.task.layout.corners(np.column_stack([np.arange(7.0), np.zeros(7), np.zeros(7)])),
        made.task.layout,
    )
    states = [filling.seen(SQUARE, (0, 0, 2, 0, 0)), filling.seen(big, (2, 1, 2, 1, 1))]
    value = OutlineValue(filling.shapes, made.agent.net)
    with torch.no_grad():
        alone = [float(value(Corners.of(one))[0]) for one in states]
        both = value(Corners.of(Rests.joined(states))).tolist()
        # Nor on the numbers in rows that hold no corner.
        states[0].points[0, states[0].part[0] == UNUSED] = 9.0
        again = float(value(Corners.of(states[0]))[0])
    assert both == pytest.approx(alone, abs=1e-5)
    assert again == pytest.approx(alone[0], abs=1e-5)
    assert abs(alone[0] - alone[1]) > 1e-4
