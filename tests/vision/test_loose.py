"""Places of tokens in an outline that may be wrong."""

import numpy as np
import pytest
from shapely import Polygon

from tangram_sim.geometry.dissections import Budget, Search, Tokens
from tangram_vision.silhouettes.loose import LoosePlaces
from tests.sim.builders import SEVEN, layout_of

pytestmark = pytest.mark.fast

TWO = Tokens(layout_of("small_triangle", "small_triangle", scale=1.0))
LEG = float(np.sqrt(2.0 * TWO.areas[0]))
SEVEN_TOKENS = Tokens(layout_of(*SEVEN, scale=1.0))


def square(side: float) -> Polygon:
    return Polygon([(0, 0), (side, 0), (side, side), (0, side)])


def test_two_triangles_lie_in_their_square_as_the_search_has_them() -> None:
    exact = {tuple(np.round(one.laid.pose, 6)) for one in _exact(square(LEG))}
    loose = {tuple(np.round(one.laid.pose, 6)) for one in LoosePlaces(TWO, 0.01)(square(LEG), (2,))}
    assert exact <= loose
    fits = [one for one in LoosePlaces(TWO, 0.01)(square(LEG), (2,)) if one.over < 1e-6]
    assert {tuple(np.round(one.laid.pose, 6)) for one in fits} == exact


def _exact(area: Polygon) -> list[object]:
    return list(Search(TWO, 0.004, Budget(np.inf)).places(area, (2,)))


@pytest.mark.parametrize(("size", "over"), [(1.0, 0.0), (0.95, 1 - 0.95**2), (0.8, 1 - 0.8**2)])
def test_a_token_may_reach_out_of_what_is_left(size: float, over: float) -> None:
    """A triangle of its own form, but smaller: it sticks out by the difference of the areas."""
    leg = size * LEG
    places = LoosePlaces(TWO, 0.1)(Polygon([(0, 0), (leg, 0), (0, leg)]), (1,))
    least = min(one.over for one in places)
    assert least == pytest.approx(over * TWO.areas[0], abs=1e-9)
    for one in places:
        assert one.polygon.area == pytest.approx(TWO.areas[0])
        assert one.over < 0.5 * TWO.areas[0]


def test_it_reaches_out_by_less_than_half_of_the_smallest_token() -> None:
    leg = 0.7 * LEG  # half of its area
    assert LoosePlaces(TWO, 0.2)(Polygon([(0, 0), (leg, 0), (0, leg)]), (1,)) == []


def test_only_tokens_that_are_left_are_laid() -> None:
    left = (0, 1, 0, 0, 0)
    places = LoosePlaces(SEVEN_TOKENS, 0.035)(square(1.0), left)
    assert {one.laid.shape for one in places} == {1}
    assert LoosePlaces(SEVEN_TOKENS, 0.035)(square(1.0), (0, 0, 0, 0, 0)) == []


def test_of_a_rugged_outline_few_corners_are_looked_at() -> None:
    """A disc with a thousand teeth would else be tried at each of them."""
    turn = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    z = (0.56 + 0.02 * (np.arange(2000) % 2)) * np.exp(1j * turn)
    teeth = Polygon(np.column_stack([z.real, z.imag]))
    places = LoosePlaces(SEVEN_TOKENS, 1e-4)._of(teeth, SEVEN_TOKENS.counts)
    assert len(places) == 40
