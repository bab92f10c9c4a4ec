"""Whether a study is whole: nothing that was planned is missing, and no run belies itself."""

import re
from collections.abc import Iterator
from itertools import product

import numpy as np

from tangram_lab.experiments.report.reading import EACH
from tangram_lab.experiments.report.study import Seed, Study, Training

COMMIT = "[0-9a-f]{7,40}"  # one with -dirty is of a source tree that was not as committed
ROUNDED = 1e-3  # what numbers of data.json may be off by, and policies on another processor
UNLEARNED = ("exact", "random", "position only")


def lacks(study: Study) -> Iterator[str]:
    """Seeds that were planned and not trained, tests that were not made, and what is otherwise."""
    for training in study.trainings:
        left = [seed.number for seed in training.seeds if not seed.finished]
        if left:
            yield f"{training.name} lacks the seeds {left}"
        for seed in training.finished:
            yield from (f"{training.name}, seed {seed.number}: {one}" for one in _odd(study, seed))
    for experiment in study.experiments:
        for training in experiment.trainings:
            for test in experiment.tests:
                if any(test.name not in seed.tests for seed in training.finished):
                    yield f"{training.name} lacks the test {test.name} of {experiment.name}"


def _odd(study: Study, seed: Seed) -> Iterator[str]:
    """Where a run is not what the plan asks for."""
    result, budget = seed.result, study.budget
    if not re.fullmatch(COMMIT, result["commit"] or ""):
        yield f"it is of a changed tree, or of none: {result['commit']}"
    if result.get("seed") != seed.number:
        yield f"its seed is {result.get('seed')}"
    if result.get("scored_updates") != result["updates"]:
        yield "it did not come to its end"
    for name, test in seed.tests.items():
        asked = {"updates": result["updates"], "test_seed": budget.test_seed}
        asked |= _counts(study, name)
        for key, value in asked.items():
            if test.get(key) != value:
                yield f"test {name} has {key}={test.get(key)}, not {value}"


def _counts(study: Study, test: str) -> dict[str, int]:
    """How many episodes a test has, or at how many angles it shows each puzzle."""
    overrides = next(one.overrides for one in study.tests if one.name == test)
    given = (re.fullmatch(r"(episodes|turns)=(\d+)", text) for text in overrides)
    counts = {found[1]: int(found[2]) for found in given if found}
    if any(text.startswith("puzzle=") for text in overrides):
        return counts
    return {"episodes": study.budget.test_episodes} | counts


def contradicts(study: Study) -> Iterator[str]:
    """Where what is told of a run is not of one piece, or one run stands for two seeds."""
    runs = dict[str, str]()
    for training in study.trainings:
        for seed in training.finished:
            told = f"{training.name}, seed {seed.number}"
            yield from (f"{told}: {one}" for one in _torn(seed))
            first = runs.setdefault(str(seed.result.get("run_id", told)), told)
            if first != told:
                yield f"{told} is the run of {first}"
        yield from _unlike(study, training)


def _torn(seed: Seed) -> Iterator[str]:
    """Where a run's curve, its result and the episodes of its tests do not fit each other."""
    last = seed.curve[-1] if seed.curve else {}
    for key in ("updates", "episodes", "mean_reward"):
        if last.get(key) != seed.result[key]:
            yield f"its curve ends with {key}={last.get(key)}, its result with {seed.result[key]}"
    for name, test in seed.tests.items():
        own, each = test["mean_reward"], test.get(EACH)
        if not abs(own) <= 1.0 or (each and abs(2.0 * np.mean(each) - 1.0 - own) > ROUNDED):
            yield f"test {name} has not the mean reward of its episodes: {own}"


def _unlike(study: Study, training: Training) -> Iterator[str]:
    """Policies that learned nothing and scored otherwise on the same episodes."""
    for test, policy in product(study.tests, UNLEARNED):
        scores = [*training.compared(policy, "mean_reward", test.name).values()]
        if scores and max(scores) - min(scores) > ROUNDED:
            yield f"{training.name}, test {test.name}: {policy} differs between seeds: {scores}"
