"""What comes between tokens and pictures of them: drawn per episode, or not at all."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from tangram_core.arrays import Pixels
from tangram_sim.config import SimConfig
from tangram_sim.sight.lens import Disturbance, Lens
from tangram_sim.sight.pictures import BACKGROUND, TOKEN_GRAY

pytestmark = pytest.mark.fast

Taken = Callable[..., Pixels]

HALF = np.full((32, 32), BACKGROUND, np.uint8)
HALF[:, :16] = TOKEN_GRAY


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> Taken:
    return partial(_taken, monkeypatch)


def _taken(
    monkeypatch: pytest.MonkeyPatch, picture: Pixels, seed: int = 0, **full: float
) -> Pixels:
    monkeypatch.setattr("tangram_sim.sight.lens.FULL", Disturbance(**full))
    lens, rng = Lens(SimConfig(pixels=32, disturbance=1.0)), np.random.default_rng(seed)
    lens.begin([rng])
    return lens.taken(0, picture, rng)


def test_without_disturbances_nothing_is_drawn() -> None:
    lens, rng = Lens(SimConfig(pixels=32)), np.random.default_rng(0)
    [view] = lens.begin([rng])
    assert lens.taken(0, HALF, rng) is HALF
    assert rng.random() == np.random.default_rng(0).random()
    assert (view.x, view.y, view.turn, lens.disturbs) == (0.0, 0.0, 0.0, False)


@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_the_camera_is_turned_and_shifted_by_what_is_told(strength: float) -> None:
    lens = Lens(SimConfig(pixels=32, arena=4.0, disturbance=strength))
    views = lens.begin([np.random.default_rng(i) for i in range(20)])
    assert {round(float(np.degrees(view.turn)), 9) for view in views} == {-strength, strength}
    far = [np.hypot(view.x, view.y) for view in views]
    np.testing.assert_allclose(far, strength * 2.0 * 4.0 / 32)


def test_noise_has_its_deviation_and_another_draw_in_each_picture(taken: Taken) -> None:
    even = np.full((64, 64), 128, np.uint8)
    one, two = (taken(even, seed, noise=8.0).astype(float) for seed in (0, 1))
    assert one.std() == pytest.approx(8.0, rel=0.1)
    assert (one - two).std() == pytest.approx(8.0 * 2**0.5, rel=0.1)


def test_a_blur_spreads_an_edge_and_keeps_the_levels_of_areas(taken: Taken) -> None:
    row = taken(HALF, blur=1.0)[16].astype(float)
    assert (row[0], row[-1]) == (TOKEN_GRAY, BACKGROUND)
    slope = np.diff(row) / (BACKGROUND - TOKEN_GRAY)
    places = np.arange(len(slope)) + 1.0
    mean = float((slope * places).sum())
    assert mean == pytest.approx(16.0, abs=0.01)
    spread = float(np.sqrt((slope * (places - mean) ** 2).sum()))
    assert spread == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_light_falls_off_by_what_is_told(seed: int, taken: Taken) -> None:
    ground = np.full((64, 64), BACKGROUND, np.uint8)
    lit = taken(ground, seed, light=0.2).astype(float) / BACKGROUND
    down, right = (np.diff(lit, axis=axis).mean() * 64 for axis in (0, 1))
    assert np.hypot(down, right) == pytest.approx(0.2, abs=0.01)
    assert lit.max() == pytest.approx(1.0, abs=0.01)
