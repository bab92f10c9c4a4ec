"""What comes between tokens and pictures of them: drawn per episode, or not at all."""

from typing import Any

import numpy as np
import pytest

from tangram_sim.arrays import Pixels
from tangram_sim.config import SimConfig
from tangram_sim.lens import Lens
from tangram_sim.pictures import BACKGROUND, TOKEN_GRAY

pytestmark = pytest.mark.fast

HALF = np.full((32, 32), BACKGROUND, np.uint8)
HALF[:, :16] = TOKEN_GRAY


def taken(picture: Pixels, seed: int = 0, **settings: Any) -> Pixels:
    lens, rng = Lens(SimConfig(pixels=32, **settings)), np.random.default_rng(seed)
    lens.begin([rng])
    return lens.taken(0, picture, rng)


def test_without_disturbances_nothing_is_drawn() -> None:
    lens, rng = Lens(SimConfig(pixels=32)), np.random.default_rng(0)
    [view] = lens.begin([rng])
    assert lens.taken(0, HALF, rng) is HALF
    assert rng.random() == np.random.default_rng(0).random()
    assert (view.x, view.y, view.turn, lens.moves) == (0.0, 0.0, 0.0, False)


def test_the_camera_is_turned_and_shifted_by_what_is_told() -> None:
    lens = Lens(SimConfig(pixels=32, arena=4.0, camera_turn=2.0, camera_shift=3.0))
    views = lens.begin([np.random.default_rng(i) for i in range(20)])
    assert {round(float(np.degrees(view.turn)), 9) for view in views} == {-2.0, 2.0}
    far = [np.hypot(view.x, view.y) for view in views]
    np.testing.assert_allclose(far, 3.0 * 4.0 / 32)


def test_noise_has_its_deviation_and_another_draw_in_each_picture() -> None:
    even = np.full((64, 64), 128, np.uint8)
    one, two = (taken(even, seed, picture_noise=8.0).astype(float) for seed in (0, 1))
    assert one.std() == pytest.approx(8.0, rel=0.1)
    assert (one - two).std() == pytest.approx(8.0 * 2**0.5, rel=0.1)


def test_a_blur_spreads_an_edge_and_keeps_the_levels_of_areas() -> None:
    row = taken(HALF, picture_blur=1.0)[16].astype(float)
    assert (row[0], row[-1]) == (TOKEN_GRAY, BACKGROUND)
    slope = np.diff(row) / (BACKGROUND - TOKEN_GRAY)
    places = np.arange(len(slope)) + 1.0
    mean = float((slope * places).sum())
    assert mean == pytest.approx(16.0, abs=0.01)
    spread = float(np.sqrt((slope * (places - mean) ** 2).sum()))
    assert spread == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_light_falls_off_by_what_is_told(seed: int) -> None:
    ground = np.full((64, 64), BACKGROUND, np.uint8)
    lit = taken(ground, seed, light_gradient=0.2).astype(float) / BACKGROUND
    down, right = (np.diff(lit, axis=axis).mean() * 64 for axis in (0, 1))
    assert np.hypot(down, right) == pytest.approx(0.2, abs=0.01)
    assert lit.max() == pytest.approx(1.0, abs=0.01)
