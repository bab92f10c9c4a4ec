"""tangram-bench nearest: what stands beside the nearest figure is a fair rival."""

import numpy as np
import pytest
import shapely
from shapely import Polygon

from tangram_lab.benchmarks.nearest import DRAWN, LAYOUT, _outline, _sized, _wobbly, best_known
from tangram_sim.puzzles import load_puzzle

pytestmark = pytest.mark.fast


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_figure_of_the_library_is_fitted_however_it_lies(mirrored: bool) -> None:
    figures = [_outline(load_puzzle(name)) for name in ("cat", "swan", "rectangle")]
    swan = shapely.affinity.rotate(figures[1], 77.0)
    swan = shapely.affinity.translate(swan, 0.4, -0.3)
    drawing = shapely.affinity.scale(swan, -1.0 if mirrored else 1.0, 1.0)
    assert best_known(drawing, figures) > 0.995
    assert best_known(drawing, figures[::2]) < 0.8


def test_an_outline_wobbles_by_so_much_and_keeps_its_area() -> None:
    whole = _sized(Polygon([(0, 0), (2, 0), (2, 1), (0, 1)]))
    assert isinstance(whole, Polygon)
    drawn = _wobbly(whole, 0.02, np.random.default_rng(0))
    assert drawn.area == pytest.approx(float(LAYOUT.areas.sum()))
    off = shapely.hausdorff_distance(drawn, whole) / np.sqrt(whole.area)
    assert 0.02 < off < 0.15


@pytest.mark.parametrize("name", DRAWN)
def test_a_drawing_is_one_simple_outline(name: str) -> None:
    assert Polygon(DRAWN[name]).is_valid
