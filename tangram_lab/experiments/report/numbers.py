"""Quantities of tables and figures: their spread over seeds, curves, and how people read them."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tangram_lab.experiments.report.study import Row, Seed
from tangram_sim.arrays import Floats

NOTHING = "-"
GRID = 200  # points of a curve of several seeds
EARLY = 0.08  # of an axis; what rises there needs a logarithmic one
KEPT = 60  # points of a curve in data.json


class Spread(NamedTuple):
    """Of some numbers."""

    least: float
    median: float
    most: float


def spread(values: Iterable[float]) -> Spread | None:
    """Of any count of numbers; None of none."""
    known = list(values)
    return Spread(min(known), statistics.median(known), max(known)) if known else None


class Measure(NamedTuple):
    """A quantity of tables and figures.

    Attributes:
        key: in result.json and in the files of tests.
        label: head of a column.
        pattern: of one number.
        factor: number in the table / number in the file.
        axis: label of an axis, with its unit; empty of what only tables show.
    """

    key: str
    label: str
    pattern: str
    factor: float = 1.0
    axis: str = ""

    def show(self, number: float | None) -> str:
        """One number, `-` if there is none."""
        if number is None:
            return NOTHING
        text = self.pattern.format(number * self.factor)
        return text[1:] if text.startswith("-") and not text.strip("-0.°,") else text

    def show_spread(self, values: Mapping[int, float]) -> str:
        """Median (least to most) over the seeds; only the median where that is all."""
        known = spread(values.values())
        if known is None:
            return NOTHING
        least, median, most = map(self.show, known)
        return median if least == median == most else f"{median} ({least} to {most})"


REWARD = Measure("mean_reward", "mean reward", "{:.3f}", axis="mean reward (\N{MINUS SIGN}1 to 1)")
DENSE = Measure(
    "mean_reward_dense",
    "mean dense reward",
    "{:.3f}",
    axis="mean dense reward, Eq. 15 (\N{MINUS SIGN}1 to 1)",
)
ANGLE = Measure(
    "angle_error_deg_median", "angle error", "{:.2f}°", axis="angle error, median (degrees)"
)
POSITION = Measure("position_error_median", "position error", "{:.4f}")
EPISODES = Measure("episodes", "episodes", "{:,.0f}", axis="episodes")
UPDATES = Measure("updates", "updates", "{:,.0f}", axis="updates (gradient steps)")
MINUTES = Measure("train_s", "training, min", "{:,.1f}", 1 / 60, "training time (minutes)")
HOURS = Measure("train_s", "training, h", "{:,.2f}", 1 / 3600)
PARAMETERS = Measure("parameters", "parameters", "{:,.0f}")


class Band(NamedTuple):
    """A curve of several seeds: its mean, and their standard deviation (n - 1), None of one."""

    x: Floats  # (G,) rising
    mean: Floats
    deviation: Floats | None
    least: Floats
    most: Floats
    seeds: int


def points(curve: Sequence[Row], axis: str, key: str) -> tuple[Floats, Floats]:
    """A curve's points (P,) against one of its axes, without those that lack the value."""
    known = [(row[axis], row[key]) for row in curve if row.get(key) is not None]
    pairs = np.array(known, dtype=float).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def rises_early(curves: Iterable[Sequence[Row]], axis: str, key: str) -> bool:
    """Whether the median curve has done half of its rise in the first `EARLY` of the axis."""
    known = [(x, y) for x, y in (points(curve, axis, key) for curve in curves) if len(x)]
    end = max((x[-1] for x, _ in known), default=0.0)
    halves = [x[np.argmax(y >= (y[0] + y.max()) / 2)] for x, y in known if y.max() > y[0]]
    return bool(halves) and bool(np.median(halves) < EARLY * end)


def band(
    curves: Iterable[Sequence[Row]], axis: str, key: str, logarithmic: bool = False
) -> Band | None:
    """Mean and deviation over the range that all curves cover, by linear interpolation.

    Seeds are evaluated at different points, so each is read at G points between the latest first
    and the earliest last evaluation. Curves without a value are left out.

    Args:
        curves: of the seeds.
        axis, key: names of x and y.
        logarithmic: the points are as far apart on a logarithmic axis, from the first above 0.

    Returns:
        None if there is no curve, or no range that all of them cover.
    """
    known = [(x, y) for x, y in (points(curve, axis, key) for curve in curves) if len(x)]
    low, high = max((x[0] for x, _ in known), default=0), min((x[-1] for x, _ in known), default=0)
    if logarithmic:
        low = max(low, min((x[x > 0].min(initial=high) for x, _ in known), default=0))
    if low >= high:
        return None
    grid = (np.geomspace if logarithmic else np.linspace)(low, high, GRID)
    values = np.stack([np.interp(grid, x, y) for x, y in known])
    deviation = values.std(axis=0, ddof=1) if len(known) > 1 else None
    least, most = values.min(axis=0), values.max(axis=0)
    return Band(grid, values.mean(axis=0), deviation, least, most, len(known))


def reached(seed: Seed, level: float) -> tuple[float, float] | None:
    """Episodes at the evaluation before, and at the one that first had a mean reward; None if none.

    What lies between nobody looked at.
    """
    x, y = points(seed.curve, EPISODES.key, REWARD.key)
    found = np.flatnonzero(y >= level)
    if not len(found):
        return None
    first = int(found[0])
    return (float(x[first - 1]) if first else 0.0), float(x[first])


def thinned(curve: Sequence[Row], count: int = KEPT) -> list[Row]:
    """At most `count` points, evenly picked, the first and the last among them."""
    if len(curve) <= count:
        return list(curve)
    picked = np.linspace(0, len(curve) - 1, count).round().astype(int)
    return [curve[index] for index in picked]
