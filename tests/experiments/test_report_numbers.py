"""Curves of several seeds on one grid, medians, and numbers as people read them."""

import bisect
import statistics
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tangram_lab.experiments.report.numbers import (
    ANGLE,
    GRID,
    MINUTES,
    REWARD,
    band,
    first_at_least,
    points,
    spread,
    thinned,
)
from tangram_lab.experiments.report.study import Seed
from tests.experiments.builders import learning_curve, result

pytestmark = pytest.mark.fast


def curve(*pairs: tuple[float, float | None]) -> list[dict[str, Any]]:
    return [{"updates": x, "mean_reward": y} for x, y in pairs]


def read_at(pairs: list[tuple[float, float]], x: float) -> float:
    """An oracle: linear between the two neighbours of x."""
    right = min(max(bisect.bisect_left([p[0] for p in pairs], x), 1), len(pairs) - 1)
    (x0, y0), (x1, y1) = pairs[right - 1 : right + 1]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)


@given(st.lists(st.integers(0, 2**32 - 1), min_size=2, max_size=4))
def test_band_is_the_mean_and_deviation_of_curves_read_at_every_point(seeds: list[int]) -> None:
    curves = []
    for seed in seeds:
        generator = np.random.default_rng(seed)
        x = np.sort(generator.uniform(0, 100, 9)) + np.arange(9)
        curves.append(list(zip(x.tolist(), generator.normal(size=9).tolist(), strict=True)))
    low, high = max(c[0][0] for c in curves), min(c[-1][0] for c in curves)
    found = band([curve(*pairs) for pairs in curves], "updates", "mean_reward")
    if low >= high:
        assert found is None
        return
    assert found is not None
    assert found.deviation is not None
    assert (found.x[0], found.x[-1], len(found.x)) == (low, high, GRID)
    for index in (0, 1, 57, GRID - 2, GRID - 1):
        values = [read_at(pairs, float(found.x[index])) for pairs in curves]
        assert found.mean[index] == pytest.approx(statistics.mean(values))
        assert found.deviation[index] == pytest.approx(statistics.stdev(values), abs=1e-9)


def test_band_of_one_seed_has_no_deviation() -> None:
    found = band([curve((0, 0.0), (10, 1.0))], "updates", "mean_reward")
    assert found is not None
    assert found.deviation is None
    assert found.seeds == 1
    np.testing.assert_allclose(found.mean, np.linspace(0, 1, GRID))


@pytest.mark.parametrize(
    "curves",
    [
        [],
        [[]],
        [curve((3, None))],
        [curve((3, 0.1))],
        [curve((0, 0), (1, 1)), curve((2, 0), (3, 1))],
    ],
)
def test_no_band_without_a_common_range(curves: Any) -> None:
    assert band(curves, "updates", "mean_reward") is None


def test_points_without_a_value_are_left_out() -> None:
    x, y = points(curve((1, 0.1), (2, None), (3, 0.3)), "updates", "mean_reward")
    assert (x.tolist(), y.tolist()) == ([1, 3], [0.1, 0.3])


@pytest.mark.parametrize(
    ("level", "expected"), [(0.1, 100), (0.735, 300), (0.75, 400), (0.8, None)]
)
def test_where_a_curve_first_reaches_a_level(level: float, expected: float | None) -> None:
    pairs = [(100, 0.2), (200, 0.6), (300, 0.735), (400, 0.75), (500, 0.74)]
    rows = tuple({"episodes": x, "mean_reward": y} for x, y in pairs)
    seed = Seed(0, "finished", result(0, 0.75), rows, {})
    assert first_at_least(seed, level) == expected


@given(st.integers(0, 300), st.integers(2, 80))
def test_thinned_curves_keep_their_ends_and_their_order(length: int, count: int) -> None:
    rows = [{"updates": index} for index in range(length)]
    kept = [row["updates"] for row in thinned(rows, count)]
    assert len(kept) == min(length, count)
    assert kept == sorted(set(kept))
    assert kept[:1] + kept[-1:] == [row["updates"] for row in rows[:1] + rows[-1:]]


def test_learning_curves_are_thinned_to_sixty_points() -> None:
    assert len(thinned(learning_curve(0, 0.7, count=500))) == 60


def test_spread() -> None:
    found = spread([0.3, 0.1, 0.2, 0.6])
    assert found is not None
    assert (found.median, found.least, found.most) == (0.25, 0.1, 0.6)
    assert spread([]) is None


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({}, "-"),
        ({0: 0.7514}, "0.751"),
        ({0: 0.75, 1: 0.7501}, "0.750"),
        ({0: 0.76, 1: 0.74, 2: 0.758}, "0.758 (0.740 to 0.760)"),
        ({0: -0.0001}, "0.000"),
    ],
)
def test_spreads_as_text(values: dict[int, float], text: str) -> None:
    assert REWARD.show_spread(values) == text


def test_units_of_numbers() -> None:
    assert ANGLE.show(0.0371) == "0.04°"
    assert ANGLE.show(-0.001) == "0.00°"
    assert MINUTES.show(90.0) == "1.5"
    assert REWARD.show_difference({0: 0.5, 1: 0.6}, {0: 0.7}) == "-0.150"
    assert ANGLE.show_difference({0: 3.0}, {0: 1.0}) == "+2.00°"
    assert ANGLE.show_difference({}, {0: 1.0}) == "-"
