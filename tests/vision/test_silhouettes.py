"""Silhouettes in pictures: outlined, filled, and judged by their pixels."""

from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import shapely
from shapely import Polygon

from tangram_core.arrays import Singles
from tangram_sim.config import SimConfig
from tangram_sim.geometry.areas import Area, overlap
from tangram_sim.geometry.dissections import Dissection, Laid
from tangram_sim.puzzles.figures import load_puzzle
from tangram_sim.sight.pictures import coverage
from tangram_sim.targets.connected import sample_connected
from tangram_sim.targets.targets import placement, turned_figure
from tangram_sim.world.world import make_world
from tangram_vision.pictures.kinds import kinds_of
from tangram_vision.silhouettes.outlines import WAYS, Way, outline
from tangram_vision.silhouettes.silhouette_pictures import _cropped, _Explainer, fill_picture
from tangram_vision.silhouettes.silhouettes import Filled, covered
from tests.sim.builders import SEVEN, layout_of

pytestmark = pytest.mark.fast

ARENA = 2.0
LAYOUT = layout_of(*SEVEN, scale=0.6)


def seen(name: str, pixels: int, angle: float = 0.7) -> tuple[Filled, Dissection]:
    """How a figure's picture is filled, and the figure."""
    poses, flipped = placement(load_puzzle(name), LAYOUT)
    truth = Dissection(turned_figure(LAYOUT, (poses, flipped), angle), flipped)
    return fill_picture(shown(truth, pixels), LAYOUT, ARENA, 20.0), truth


def shown(lies: Dissection, pixels: int) -> Singles:
    """Coverage by tokens in a picture."""
    sim = SimConfig(backend="kinematic", arena=ARENA, pixels=pixels, observe="pictures")
    with closing(make_world(LAYOUT, sim)) as world:
        world.place(lies.poses, lies.flipped)
        return coverage(world.picture())


@pytest.mark.parametrize(("pixels", "least"), [(128, 0.99), (64, 0.97)])
@pytest.mark.parametrize("name", ["cat", "swan", "hut", "exclamation_mark"])
def test_figures_are_filled_from_their_pictures(name: str, pixels: int, least: float) -> None:
    filled, truth = seen(name, pixels)
    assert filled.found is not None
    middle = np.array([-ARENA / 2.0, ARENA / 2.0, 0.0])
    laid = Dissection(filled.found.poses + middle, filled.found.flipped)
    assert overlap(covered(LAYOUT, laid), covered(LAYOUT, truth)) > least
    assert filled.iou > least - 0.01


@pytest.mark.parametrize("way", WAYS[:2])
def test_an_outline_has_the_sides_and_the_hole_that_the_picture_shows(way: Way) -> None:
    """An L with a square hole, turned by half a radian."""
    corners = np.array([0, 60, 60 + 30j, 30 + 30j, 30 + 60j, 60j]) - 25 - 25j
    hole = np.array([8 + 8j, 20 + 8j, 20 + 20j, 8 + 20j]) - 25 - 25j
    true = shapely.difference(
        *(
            Polygon(np.column_stack([z.real, z.imag]))
            for z in ((one * np.exp(0.5j) + 64 - 64j) for one in (corners, hole))
        )
    )
    times = 8
    y, x = np.mgrid[: 128 * times, : 128 * times]
    points = ((x + 0.5) / times, -(y + 0.5) / times)
    fine = shapely.contains_xy(true, *points).astype(np.float32)
    cover = fine.reshape(128, times, 128, times).mean(axis=(1, 3))
    found = outline(cover, way)
    assert overlap(found, true) > 0.985
    (part,) = shapely.get_parts(found)
    assert (len(part.exterior.coords) - 1, len(part.interiors)) == (6, 1)


def test_what_is_too_rugged_has_no_outline() -> None:
    """A hundred thousand crossings would take minutes to be cut into sides."""
    noise = (np.random.default_rng(0).random((256, 256)) < 0.5).astype(np.float32)
    assert outline(noise, WAYS[0]).is_empty


def test_nothing_has_no_outline() -> None:
    assert outline(np.zeros((64, 64), np.float32), WAYS[0]).is_empty
    assert fill_picture(np.zeros((64, 64), np.float32), LAYOUT, ARENA, 1.0).found is None


def rough(seed: int, pixels: int) -> tuple[Singles, Dissection]:
    """Coverage by tokens laid edge to edge by chance, and how they lie."""
    own = np.random.default_rng(seed)
    poses = sample_connected(LAYOUT, SimConfig(arena=ARENA), own)
    truth = Dissection(poses, np.zeros(LAYOUT.tokens, np.bool_))
    return shown(truth, pixels), truth


def test_coarse_pictures_are_filled_by_the_beam_where_no_search_fills_them() -> None:
    middle, by, solved = np.array([-ARENA / 2.0, ARENA / 2.0, 0.0]), list[str](), 0
    for seed in range(4):
        cover, truth = rough(seed, 64)
        filled = fill_picture(cover, LAYOUT, ARENA, 20.0)
        assert filled.found is not None
        laid = Dissection(filled.found.poses + middle, filled.found.flipped)
        by.append(filled.by)
        solved += overlap(covered(LAYOUT, laid), covered(LAYOUT, truth)) > 0.9
    assert solved >= 3
    assert set(by) == {"search", "beam"}


def test_tokens_that_lie_wrong_are_laid_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """The only thing that ever explains all of a figure has two tokens turned about."""
    cover, truth = rough(1, 128)
    _, corner = _cropped(cover)
    poses = truth.poses + (ARENA / 2.0, -ARENA / 2.0, 0.0) - (*corner * ARENA / 128, 0.0)
    poses[[2, 5], 2] += 0.8
    wrong = Dissection(poses, truth.flipped)
    lay, iou = _Explainer._lay, []

    def offered(self: _Explainer, area: Area, kept: Sequence[Laid], *rest: Any) -> bool:
        if kept:
            return lay(self, area, kept, *rest)
        return self._offer([self._laid(wrong, k) for k in range(7)], "beam")

    monkeypatch.setattr(_Explainer, "_search", lambda *_: False)
    monkeypatch.setattr(_Explainer, "_lay", offered)
    for tried in (0, 12):
        monkeypatch.setattr("tangram_vision.silhouettes.silhouette_pictures._TRIED", tried)
        iou.append(fill_picture(cover, LAYOUT, ARENA, 20.0).iou)
    assert iou[0] < 0.95
    assert iou[1] > 0.97


def test_what_explains_a_picture_worse_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    cover, truth = rough(1, 128)
    crop, corner = _cropped(cover)
    unit = ARENA / 128
    explainer = _Explainer(crop, LAYOUT, kinds_of(LAYOUT, ARENA, 128), unit)
    poses = truth.poses + (ARENA / 2.0, -ARENA / 2.0, 0.0) - (*corner * unit, 0.0)
    off = poses + np.array([(0.1 * (k == 0), 0.0, 0.8 * (k == 0)) for k in range(7)])
    for own, alike in ((off, False), (poses, True), (off, True)):
        laid = [explainer._laid(Dissection(own, truth.flipped), k) for k in range(7)]
        assert explainer._offer(laid, "beam") is alike
    assert explainer.best is not None
    assert explainer.best.differs < 0.02
    monkeypatch.setattr("tangram_vision.silhouettes.silhouette_pictures._overlap", lambda *_: 0.94)
    assert explainer._offer(laid, "beam") is False
