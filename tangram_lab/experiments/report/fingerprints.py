"""Fingerprints of the code that trains: what 20 updates in lockstep come to, for each family.

Figures stay true while a training comes to the same numbers as when they were made.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import torch

from master.trainer import Trainer
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.types import Weights
from worker.looking import environments
from worker.rollout import Rollout
from worker.test_set import FixedTests, greedy

UPDATES = 20
SETTINGS = {"agent.batch_size": 16, "agent.learning_starts": 32}
SEED, ENVS, BATCH_EPISODES, TEST_EPISODES = 0, 4, 8, 8
SCORES = ("mean_reward", "raw_overlap", "angle_error_deg_p90", "position_error_p90")
TOLERANCE = 1e-3  # other processors add numbers up in another order

Fingerprint = dict[str, float]
MakeSetup = Callable[[Sequence[str]], Setup]  # from the arguments of a training


def make_fingerprints(
    trainings: Mapping[str, Mapping[str, Any]], make: MakeSetup
) -> dict[str, Fingerprint]:
    """Family -> its fingerprint, by the first of its trainings.

    Args:
        trainings: of a plan.
        make: the setup that arguments come to.

    Raises:
        ConfigError: this code refuses a training.
    """
    torch.set_num_threads(1)
    return {
        family: make_fingerprint(make(arguments))
        for family, arguments in families(trainings).items()
    }


def families(trainings: Mapping[str, Mapping[str, Any]]) -> dict[str, list[str]]:
    """Family -> the arguments of the first of its trainings, with those of a short one."""
    firsts = dict[str, list[str]]()
    for training in trainings.values():
        if training["family"] not in firsts:
            said = {text.partition("=")[0]: text for text in training["overrides"]}
            said |= {name: f"{name}={value}" for name, value in SETTINGS.items()}
            firsts[training["family"]] = [*said.values()]
    return firsts


def make_fingerprint(setup: Setup) -> Fingerprint:
    """The scores after 20 updates, and the sum of all weights without their signs.

    It learns as `tangram-train service.mode=lockstep` does with one worker, number for number, but
    in this process: a test compares the two.
    """
    trainer, policy = Trainer(setup, SEED, "cpu"), Policy(setup)
    with closing(environments(setup, ENVS)) as env:
        rollout = Rollout(env, SEED, "player", 0, 0)
        while trainer.updates < UPDATES:
            newest = trainer.weights()
            policy.follow(newest)
            rollout.follow(newest.version)
            trainer.insert(rollout.play(policy.explore, BATCH_EPISODES // ENVS))
            while trainer.rate_limiter.may_update() and trainer.updates < UPDATES:
                trainer.update(trainer.updates / UPDATES)
    learned = trainer.learner.acting_weights(trainer.updates)
    policy.load(learned)
    with closing(FixedTests(setup, TEST_EPISODES, ENVS)) as tests:
        scores = tests.scores(tests.play(greedy(policy)))
    return {**{name: scores[name] for name in SCORES}, "weights": sum_of(learned)}


def sum_of(weights: Weights) -> float:
    """Of all weights, without their signs."""
    return math.fsum(
        float(np.abs(one.astype(np.float64)).sum()) for one in weights.tensors.values()
    )


def differences(
    names: Iterable[str], stored: Mapping[str, Fingerprint], now: Mapping[str, Fingerprint]
) -> Iterator[str]:
    """Where a family trains otherwise than it did, or nobody kept how it did.

    Args:
        names: of all families.
        stored, now: family -> its fingerprint.
    """
    for family in names:
        if family not in stored:
            yield f"family {family} has no fingerprint: make the report with fingerprints=true"
        for name, value in stored.get(family, {}).items():
            found = now[family].get(name)
            if found is None or not np.isclose(found, value, rtol=TOLERANCE, atol=TOLERANCE):
                yield (
                    f"family {family} trains otherwise than when its figures were made: after "
                    f"{UPDATES} updates {name} is {found}, and was {value}: make them anew with "
                    "make evidence"
                )
