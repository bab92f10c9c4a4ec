"""Silhouettes seen aslant: brought back where their sides ask for it, and else left alone."""

import numpy as np
import pytest
import shapely
from PIL import Image, ImageDraw
from shapely import Polygon

from tangram_core.arrays import Singles
from tangram_sim.config import SimConfig
from tangram_sim.geometry.areas import Area, overlap
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.targets.connected import sample_connected
from tangram_vision.given.photos import find_silhouette
from tangram_vision.silhouettes.outlines import Way, outline
from tangram_vision.silhouettes.silhouette_pictures import fill_picture
from tangram_vision.silhouettes.silhouettes import covered
from tangram_vision.silhouettes.tilts import from_above, mapped
from tests.sim.builders import SEVEN, layout_of
from tests.vision.aslant import photographed

pytestmark = pytest.mark.slow

LAYOUT = layout_of(*SEVEN, scale=0.6)
# Eight sides on one grid: a house with a step.
HOUSE = np.array([0, 4, 4 + 2j, 3 + 3j, 2 + 2j, 2 + 3j, 1 + 3j, 3j]) * np.exp(0.5j)


def polygon(z: np.ndarray) -> Polygon:
    return Polygon(np.column_stack([z.real, z.imag]))


def gluing(seed: int) -> Area:
    poses = sample_connected(LAYOUT, SimConfig(arena=2.0), np.random.default_rng(seed))
    return covered(LAYOUT, Dissection(poses, np.zeros(LAYOUT.tokens, np.bool_)))


def cover_of(picture: Image.Image) -> Singles:
    levels = np.asarray(picture, np.float32)
    return (levels.max() - levels) / (levels.max() - levels.min())


def shown(cover: Singles, true: Area) -> float:
    """How much of a figure its picture shows, moved and scaled onto it."""
    found = outline(cover, Way(0.15, 20.0, grid=False))
    scale = np.sqrt(true.area / found.area)
    x, y = true.centroid.x - scale * found.centroid.x, true.centroid.y - scale * found.centroid.y
    return overlap(shapely.transform(found, lambda points: points * scale + (x, y)), true)


@pytest.mark.parametrize(
    ("area", "tilt", "towards"),
    [
        (polygon(HOUSE), 8.0, 235.0),
        (polygon(HOUSE), 15.0, 10.0),
        (gluing(1), 8.0, 10.0),
        (gluing(1), 15.0, 235.0),
    ],
    ids=range(4),
)
def test_a_figure_seen_aslant_is_brought_back(area: Area, tilt: float, towards: float) -> None:
    cover = cover_of(photographed(area, tilt, towards))
    above, back = from_above(cover)
    assert shown(above, area) > max(0.985, shown(cover, area))
    assert above.sum() == pytest.approx(cover.sum(), rel=0.06)
    # What lies above comes back to where the camera saw it.
    drawn_back = shapely.transform(
        outline(above, Way(0.15, 20.0, grid=False)),
        lambda points: mapped(back, points * (1.0, -1.0)) * (1.0, -1.0),
    )
    assert overlap(drawn_back, outline(cover, Way(0.15, 20.0, grid=False))) > 0.985


@pytest.mark.parametrize("tilt", [0.0, 1.5])
def test_what_is_seen_about_from_above_is_left_alone(tilt: float) -> None:
    """What so small a tilt changes, the search bears."""
    cover = cover_of(photographed(polygon(HOUSE), tilt, 30.0))
    above, back = from_above(cover)
    assert above is cover
    np.testing.assert_array_equal(back, np.eye(3))


def drawn(*rings: np.ndarray) -> Singles:
    """Coverage (256, 256) by polygons, 4 points along a pixel."""
    canvas = Image.new("L", (1024, 1024), 225)
    brush = ImageDraw.Draw(canvas)
    for z in rings:
        brush.polygon([(float(point.real), float(point.imag)) for point in z], 50)
    return cover_of(canvas.resize((256, 256), Image.Resampling.BOX))


def test_a_figure_whose_sides_fit_no_camera_is_left_alone() -> None:
    """Nine sides at random, and a house beside a square that is turned by 11 degrees."""
    rng = np.random.default_rng(2)
    angles = np.sort(rng.uniform(0.0, 0.3, 9) + np.arange(9) * 0.68)
    random = 512.0 + 512j + rng.uniform(250.0, 450.0, 9) * np.exp(1j * angles)
    square = np.array([0, 1, 1 + 1j, 1j]) * np.exp(0.7j) * 250.0 + 300.0 + 600j
    for cover in (drawn(random), drawn(HOUSE * 120.0 + 500.0 + 50j, square)):
        assert from_above(cover)[0] is cover


def test_few_sides_tell_no_camera() -> None:
    """Any four sides may be a square's, seen aslant."""
    angles = np.arange(4) * np.pi / 2.0 + np.array([0.04, -0.07, -0.14, -0.15])
    cover = drawn(512.0 + 512j + 400.0 * np.exp(1j * angles))
    assert from_above(cover)[0] is cover


def test_a_camera_that_would_stand_too_low_is_not_believed() -> None:
    cover = cover_of(photographed(polygon(HOUSE), 50.0, 30.0))
    assert from_above(cover)[0] is cover


def test_nothing_is_left_alone() -> None:
    cover = np.zeros((64, 64), np.float32)
    assert from_above(cover)[0] is cover


def test_a_photograph_taken_aslant_is_filled_as_if_from_above(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without the correction it is filled worse, or not."""
    picture = photographed(gluing(1), 12.0, 77.0)
    iou = []
    for straightened, seconds in ((lambda part: (part, np.eye(3)), 2.0), (from_above, 30.0)):
        monkeypatch.setattr("tangram_vision.given.photos.from_above", straightened)
        cover = find_silhouette(picture, LAYOUT, "it").cover
        view = float(np.sqrt(LAYOUT.areas.sum() / cover.mean()))
        iou.append(fill_picture(cover, LAYOUT, view, seconds).iou)
    assert iou[1] > max(0.98, iou[0] + 0.01)
