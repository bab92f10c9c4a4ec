"""The picture of what is left, and what is learned from it."""

from typing import Any

import numpy as np
import pytest
import shapely
import torch
from shapely import Polygon
from torch import Tensor

from tangram_agent.crops import PIXELS, SIDE, CropValue, pictures
from tangram_agent.filling import UNUSED, Filling, Rests
from tangram_agent.filling_learner import FillLearner
from tangram_agent.networks import outline_network
from tangram_agent.values import Corners
from tangram_sim.errors import ConfigError
from tangram_sim.rings import unit_of
from tests.agent.builders import setup
from tests.agent.outlines import ALL, CROPS, TWO, outline_setup

pytestmark = pytest.mark.fast

MADE = outline_setup(ALL, net=CROPS)
FILLING = Filling(MADE.layout)
EVERY = (2, 1, 2, 1, 1)
PIXEL = unit_of(MADE.layout) * SIDE / PIXELS  # in units of the arena
MIDDLE = PIXELS // 2
HOUSE = Polygon([(0, 0), (13, 0), (10, 4), (5, 9), (0, 4)])


def seen(area: shapely.Geometry, left: tuple[int, ...] = EVERY) -> Rests:
    """A state whose area is given in pixels."""
    return FILLING.seen(shapely.transform(area, lambda points: points * PIXEL), left)


def drawn(*areas: shapely.Geometry) -> Tensor:
    return pictures(Corners.of(Rests.joined([seen(area) for area in areas])))


def begun(one: Rests, by: int) -> Rests:
    """The same state, whose corners are told beginning at another one."""
    used = int((one.part != UNUSED).sum())
    order = np.append(np.roll(np.arange(used), -by), np.arange(used, one.points.shape[1]))
    follow = np.argsort(order)[one.follow[:, order]].astype(np.uint8)
    return Rests(one.points[:, order], follow, one.part[:, order], one.left)


def test_a_square_fills_its_pixels_and_no_others() -> None:
    wanted = torch.zeros(PIXELS, PIXELS)
    wanted[MIDDLE - 4 : MIDDLE + 4, MIDDLE - 4 : MIDDLE + 4] = 1.0
    (found,) = drawn(shapely.box(0, 0, 8, 8))
    assert found == pytest.approx(wanted.numpy(), abs=1e-5)


def test_a_side_within_pixels_fills_a_share_of_them() -> None:
    """Nine by seven pixels: half a one beyond on every side, and a quarter in corners."""
    wide, high = torch.ones(10), torch.ones(8)
    wide[[0, -1]] = high[[0, -1]] = 0.5
    wanted = torch.zeros(PIXELS, PIXELS)
    wanted[MIDDLE - 4 : MIDDLE + 4, MIDDLE - 5 : MIDDLE + 5] = high[:, None] * wide
    (found,) = drawn(shapely.box(0, 0, 9, 7))
    assert found == pytest.approx(wanted.numpy(), abs=1e-4)


def test_a_triangle_lies_on_its_longest_side() -> None:
    """Sixteen pixels long; two less from row to row, with half a pixel at either end."""
    wanted = torch.zeros(PIXELS, PIXELS)
    for row in range(8):
        first, last = MIDDLE - 8 + row, MIDDLE + 7 - row
        wanted[MIDDLE - 4 + row, first : last + 1] = 1.0
        wanted[MIDDLE - 4 + row, [first, last]] = 0.5
    leg = 8.0 * 2.0**0.5
    (found,) = drawn(Polygon([(0, 0), (leg, 0), (0, leg)]))
    assert found == pytest.approx(wanted.numpy(), abs=1e-4)


def test_a_hole_is_empty_and_a_second_part_is_seen() -> None:
    hole, apart = shapely.box(4, 4, 8, 8), shapely.box(16, 0, 20, 12)
    (found,) = drawn(shapely.box(0, 0, 12, 12).difference(hole).union(apart))
    wanted = torch.zeros(PIXELS, PIXELS)
    low, left = MIDDLE - 6, MIDDLE - 10
    wanted[low : low + 12, left : left + 12] = 1.0
    wanted[low + 4 : low + 8, left + 4 : left + 8] = 0.0
    wanted[low : low + 12, left + 16 : left + 20] = 1.0
    # Which of equally long sides is the longest is not told.
    assert min(float((found - one).abs().max()) for one in _turns(wanted)) < 1e-4


def _turns(picture: Tensor) -> list[Tensor]:
    """A picture in all quarters of a turn, and in a mirror."""
    quarters = [torch.rot90(picture, i) for i in range(4)]
    return quarters + [one.flip(0) for one in quarters]


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0, -1.1])
def test_all_pixels_have_the_area_wherever_it_lies(angle: float) -> None:
    moved = shapely.affinity.rotate(HOUSE, angle, use_radians=True)
    first, found = drawn(HOUSE, shapely.affinity.translate(moved, 7, -3))
    assert found.sum() == pytest.approx(HOUSE.area, rel=1e-4)
    assert found == pytest.approx(first.numpy(), abs=1e-3)


def test_a_state_turned_or_in_a_mirror_is_its_picture_turned_or_in_a_mirror() -> None:
    one = seen(HOUSE)
    own = _turns(pictures(Corners.of(one))[0])
    turned = Rests.joined([one] * 64).turned(np.random.default_rng(0))
    every = pictures(Corners.of(turned))
    assert every.sum(dim=(1, 2)) == pytest.approx(HOUSE.area, rel=1e-4)
    # Sides that pass aslant are drawn a little otherwise along x than along y.
    off = torch.stack([(every - picture).abs().mean(dim=(1, 2)) for picture in own])
    near = off.amin(dim=0) < 1e-3
    assert set(off.argmin(dim=0)[near].tolist()) == set(range(8))
    assert off.amin(dim=0)[~near].min() > 1e-2  # by an odd number of eighths


def test_what_is_larger_than_the_picture_is_drawn_smaller() -> None:
    (found,) = drawn(shapely.box(0, 0, 2 * PIXELS, PIXELS))
    wanted = torch.zeros(PIXELS, PIXELS)
    wanted[PIXELS // 4 : -PIXELS // 4] = 1.0
    assert found == pytest.approx(wanted.numpy(), abs=1e-4)


def test_a_value_is_the_same_whatever_corner_begins_and_whatever_stands_beside_it() -> None:
    ring = shapely.box(0, 0, 12, 12).difference(shapely.box(3, 4, 8, 8))
    states = Rests.joined([seen(ring), seen(HOUSE)])
    value = outline_network(MADE)
    with torch.no_grad():
        both = value(Corners.of(states))
        for by in (1, 2, 4, 7):
            again = Rests.joined([begun(seen(one), by) for one in (ring, HOUSE)])
            assert value(Corners.of(again)) == pytest.approx(both.numpy(), abs=1e-5)
        states.points[states.part == UNUSED] = 9.0
        alone = [float(value(Corners.of(states.at(slice(i, i + 1))))[0]) for i in range(2)]
    assert alone == pytest.approx(both.numpy(), abs=1e-5)
    assert abs(alone[0] - alone[1]) > 1e-4


def test_a_state_without_corners_is_an_empty_picture_of_one_value() -> None:
    shapes = FILLING.shapes
    nothing = Rests.empty(3, FILLING.corners, shapes)
    nothing.left[1:] = [[2, 1, 2, 1, 1], [0, 0, 1, 0, 0]]
    assert (pictures(Corners.of(nothing)) == 0).all()
    value = CropValue(shapes, MADE.net)
    with torch.no_grad():
        values = value(Corners.of(Rests.joined([nothing, seen(HOUSE)])))
    assert values.isfinite().all()
    assert values[:3] == pytest.approx(values[0].item(), abs=1e-6)


def test_the_tokens_left_count() -> None:
    value = outline_network(MADE)
    with torch.no_grad():
        one, other = value(Corners.of(Rests.joined([seen(HOUSE), seen(HOUSE, (0, 0, 1, 0, 0))])))
    assert abs(one - other) > 1e-4


def test_its_weights_begin_from_the_seed_alone() -> None:
    made = outline_setup(TWO, net=CROPS)
    one, same, other = (FillLearner(made, seed).value.state_dict() for seed in (0, 0, 1))
    assert any("convolutions" in name for name in one)
    for name, values in one.items():
        assert (values == same[name]).all(), name
        assert (values != other[name]).any(), name


@pytest.mark.parametrize(
    ("net", "reason"),
    [
        (CROPS | {"width": 32}, "net.width=32 changes nothing with net.kind=crops"),
        (CROPS | {"layers": 2}, "net.layers=2 changes nothing with net.kind=crops"),
        (CROPS | {"heads": 2}, "net.heads=2 changes nothing with net.kind=crops"),
        (CROPS | {"feed_forward": 8}, "net.feed_forward=8 changes nothing with net.kind=crops"),
        (CROPS | {"scale": "sqrt_d"}, "net.scale=sqrt_d changes nothing with net.kind=crops"),
        ({"kind": "mlp"}, "net.kind=mlp changes nothing with outlines.*set net.kind=mha or crops"),
    ],
)
def test_what_a_picture_cannot_use_is_refused(net: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        outline_setup(TWO, net=net)


@pytest.mark.parametrize("readout", ["pair", "token"])
def test_agents_that_see_no_outline_have_no_picture_of_it(readout: str) -> None:
    reason = rf"net.kind=crops sees .* agent.readout={readout} is not shown: set sim=silhouette"
    with pytest.raises(ConfigError, match=reason):
        setup(agent={"readout": readout}, net=CROPS)
