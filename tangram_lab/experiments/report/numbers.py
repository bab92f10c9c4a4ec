"""Medians with their spread, and curves of several seeds on one grid."""

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tangram_lab.experiments.report.records import Row
from tangram_lab.experiments.report.study import Seed
from tangram_sim.arrays import Floats

GRID = 200
KEPT = 60


@dataclass(frozen=True)
class Spread:
    """Median, least and most of some numbers."""

    median: float
    least: float
    most: float


def spread(values: Iterable[float]) -> Spread | None:
    """Of any count of numbers; None of none."""
    known = list(values)
    return Spread(statistics.median(known), min(known), max(known)) if known else None


@dataclass(frozen=True, eq=False)
class Band:
    """A curve of several seeds.

    Attributes:
        x: (G,) grid, rising.
        mean: (G,) over the seeds.
        deviation: (G,) standard deviation over the seeds (n - 1); None of one seed.
        seeds: how many.
    """

    x: Floats
    mean: Floats
    deviation: Floats | None
    seeds: int


def points(curve: Sequence[Row], axis: str, key: str) -> tuple[Floats, Floats]:
    """A curve's points (P,) against one of its axes, without those that lack the value."""
    known = [(row[axis], row[key]) for row in curve if row.get(key) is not None]
    pairs = np.array(known, dtype=float).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def band(curves: Iterable[Sequence[Row]], axis: str, key: str) -> Band | None:
    """Mean and deviation over the range that all curves cover, by linear interpolation.

    Seeds are evaluated at different points, so each is read at G points between the latest first
    and the earliest last evaluation. Curves without a value are left out.

    Returns:
        None if there is no curve, or no range that all of them cover.
    """
    known = [(x, y) for x, y in (points(curve, axis, key) for curve in curves) if len(x)]
    if not known:
        return None
    low, high = max(x[0] for x, _ in known), min(x[-1] for x, _ in known)
    if low >= high:
        return None
    grid = np.linspace(low, high, GRID)
    values = np.stack([np.interp(grid, x, y) for x, y in known])
    deviation = values.std(axis=0, ddof=1) if len(known) > 1 else None
    return Band(grid, values.mean(axis=0), deviation, len(known))


def first_at_least(
    seed: Seed, level: float, axis: str = "episodes", key: str = "mean_reward"
) -> float | None:
    """Where the curve first reaches a level; None if it never does."""
    x, y = points(seed.curve, axis, key)
    reached = np.flatnonzero(y >= level)
    return float(x[reached[0]]) if len(reached) else None


def thinned(curve: Sequence[Row], count: int = KEPT) -> list[Row]:
    """At most `count` points, evenly picked, the first and the last among them."""
    if len(curve) <= count:
        return list(curve)
    picked = np.linspace(0, len(curve) - 1, count).round().astype(int)
    return [curve[index] for index in picked]
