"""Interquartile means with their intervals, and performance profiles (Agarwal et al. 2021).

By `rliable`, of the extra `statistics`. Legend: R runs (seeds), T tasks, L levels.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from tangram_sim.arrays import Floats
from tangram_sim.errors import RunError

ENOUGH = 8  # seeds: of fewer the bootstrap's intervals are too narrow
REPETITIONS = 2000  # of the bootstrap
SEED = 0  # of its draws: the same data give the same page


class Interval(NamedTuple):
    """An estimate and its 95 % interval."""

    estimate: float
    low: float
    high: float


def interquartile_mean(scores: Floats) -> Interval:
    """Of scores (R, T); runs are drawn anew within each task (stratified bootstrap).

    Raises:
        RunError: the extra is not installed.
    """
    library, metrics = _rliable()

    def estimate(drawn: Floats) -> Floats:
        return np.array([metrics.aggregate_iqm(drawn)])

    with _seeded():
        points, intervals = library.get_interval_estimates({"": scores}, estimate, reps=REPETITIONS)
    return Interval(float(points[""][0]), *map(float, intervals[""][:, 0]))


def difference(ours: Floats, theirs: Floats) -> Interval:
    """Of the means of two agents, (R1, E) and (R2, E), on the same E test episodes.

    Seeds are drawn anew for each agent, episodes for both together.
    """
    generator = np.random.default_rng(SEED)
    episodes = generator.integers(ours.shape[1], size=(REPETITIONS, ours.shape[1]))

    def means(scores: Floats) -> Floats:
        seeds = generator.integers(len(scores), size=(REPETITIONS, len(scores)))
        each = zip(seeds, episodes, strict=True)
        return np.array([scores[seed].mean(axis=0)[episode].mean() for seed, episode in each])

    found = means(ours) - means(theirs)
    return Interval(
        float(ours.mean() - theirs.mean()), *map(float, np.quantile(found, (0.025, 0.975)))
    )


def profile(scores: Floats, levels: Floats) -> tuple[Floats, Floats]:
    """(L,) share of runs above each level, all tasks alike, and its 95 % interval (2, L).

    Raises:
        RunError: the extra is not installed.
    """
    library, _ = _rliable()
    with _seeded():
        shares, intervals = library.create_performance_profile(
            {"": scores}, levels, reps=REPETITIONS
        )
    return shares[""], intervals[""]


@contextmanager
def _seeded() -> Iterator[None]:
    """Draws that are the same each time: rliable 1.2 draws from numpy's global generator alone."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(SEED)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002


def _rliable() -> tuple[Any, Any]:
    try:
        from rliable import library, metrics  # noqa: PLC0415 # only where there are many seeds
    except ImportError:
        raise RunError(
            "the mean of the middle half of many seeds needs rliable: install '.[statistics]'"
        ) from None
    return library, metrics
