"""Outlines as an agent sees them that plays by pictures."""

import numpy as np
import pytest
import shapely
import shapely.affinity
from shapely import Polygon

from tangram_sim.areas import Area, overlap
from tangram_sim.config import SimConfig
from tangram_sim.lens import View
from tangram_sim.pictures import BACKGROUND
from tangram_sim.rings import as_area
from tangram_vision.tracing import PictureTracer
from tests.sim.builders import SEVEN, layout_of

pytestmark = pytest.mark.fast

LAYOUT = layout_of(*SEVEN, scale=0.6)
STRAIGHT = View(0.0, 0.0, 0.0, np.zeros(2))
ROWS = 30
HOUSE = Polygon([(-0.4, -0.4), (0.3, -0.4), (0.3, 0.2), (-0.05, 0.55), (-0.4, 0.2)])
RING = shapely.difference(shapely.box(-0.5, -0.5, 0.5, 0.4), shapely.box(-0.2, -0.2, 0.2, 0.1))


def tracer(pixels: int, picture: str = "grey") -> PictureTracer:
    sim = SimConfig(observe="silhouette_pictures", pixels=pixels, picture=picture)
    return PictureTracer(LAYOUT, sim, ROWS)


@pytest.mark.parametrize(
    ("pixels", "picture", "least"), [(64, "binary", 0.93), (64, "grey", 0.97), (128, "grey", 0.99)]
)
@pytest.mark.parametrize("area", [HOUSE, RING], ids=["house", "ring"])
def test_what_was_shown_is_found_again(area: Area, pixels: int, picture: str, least: float) -> None:
    made = tracer(pixels, picture)
    for seed in range(12):  # whatever way is drawn
        rows = made.trace(made.portrait(area, STRAIGHT), np.random.default_rng(seed))
        assert rows.shape == (ROWS, 2)
        assert overlap(as_area(rows), area) > least


def test_ways_differ_and_come_from_the_generator() -> None:
    made = tracer(64, "binary")
    turned = shapely.affinity.rotate(RING, 10.0)
    picture = made.portrait(turned, STRAIGHT)
    found = [made.trace(picture, np.random.default_rng(seed)) for seed in (0, 0, *range(1, 9))]
    np.testing.assert_array_equal(found[0], found[1])
    assert len({rows.tobytes() for rows in found}) > 2


@pytest.mark.parametrize("what", ["nothing", "noise", "comb"])
def test_of_what_is_too_rugged_nothing_is_traced(what: str) -> None:
    made, generator = tracer(64), np.random.default_rng(0)
    teeth = shapely.union_all(
        [shapely.box(x, -0.8, x + 0.06, 0.8) for x in np.arange(-0.9, 0.9, 0.12)]
    )
    pictures = {
        "nothing": np.full((64, 64), BACKGROUND, np.uint8),
        "noise": generator.integers(0, 256, (64, 64)).astype(np.uint8),
        "comb": made.portrait(teeth, STRAIGHT),
    }
    rows = made.trace(pictures[what], generator)
    assert not rows.any()
    assert as_area(rows).is_empty
