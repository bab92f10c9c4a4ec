"""Fingerprints of the code that trains: what 20 updates in lockstep come to, for each training.

Figures stay true while a training comes to the same numbers as when they were made, whatever else
of the code has changed.
"""

import math
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from master.trainer import Trainer
from tangram_agent.learner import NotFiniteError
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup, make_setup
from worker.looking import environments
from worker.rollout import Rollout
from worker.test_set import FixedTests, greedy

UPDATES = 20
BATCH_SIZE, LEARNING_STARTS, CAPACITY, PACE = 16, 32, 256, 1.0  # instead of the agent's
SEED, ENVS, BATCH_EPISODES, TEST_EPISODES = 0, 4, 8, 8
TOLERANCE = 1e-3
# Processors of another make add numbers up in another order. Of 63 trainings an Intel came to the
# scores of an AMD in 57; in all 63 the weights agreed, and how far they had moved within 3 %.
ELSEWHERE = {"weights": TOLERANCE, "moved": 0.1}

Fingerprint = dict[str, float]
Tensors = Mapping[str, npt.NDArray[Any]]


def make_fingerprints(configs: Mapping[str, Mapping[str, Any]]) -> dict[str, Fingerprint]:
    """Training -> what it comes to by the code as it is; nothing where that is not finite.

    Args:
        configs: training -> its whole config.

    Raises:
        ConfigError: this code refuses a training.
    """
    torch.set_num_threads(1)
    found = dict[str, Fingerprint]()
    for name, config in configs.items():
        try:
            found[name] = make_fingerprint(make_setup(config))
        except NotFiniteError:
            found[name] = {}
    return found


def make_facts(config: Mapping[str, Any]) -> dict[str, Any]:
    """What the result of every run of a training tells of its task and its agent.

    Args:
        config: the training's whole config.

    Raises:
        ConfigError: this code refuses it.
    """
    facts = Trainer(short(make_setup(config)), SEED, "cpu").facts()
    return {name: fact for name, fact in facts.items() if name != "device"}


def differences(before: Fingerprint, now: Fingerprint, elsewhere: bool = False) -> list[str]:
    """The numbers that are not what they were.

    Args:
        before, now: to compare.
        elsewhere: they were made on processors of another make, so that scores may differ.
    """
    return [
        f"{name} is {now.get(name)}, and was {before.get(name)}"
        for name in {**now, **before}
        if (bound := ELSEWHERE.get(name) if elsewhere else TOLERANCE) is not None
        and not np.isclose(before.get(name, np.nan), now.get(name, np.nan), rtol=bound, atol=bound)
    ]


def make_fingerprint(setup: Setup) -> Fingerprint:
    """All scores after 20 updates, and sums over the weights: of what they are, and how they moved.

    It learns as `tangram-train service.mode=lockstep` does with one worker, number for number, but
    in this process: a test compares the two.
    """
    setup = short(setup)
    trainer, policy = Trainer(setup, SEED, "cpu"), Policy(setup)
    first = trainer.learner.acting_weights(0).tensors
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
    found = scores | sums(first, learned.tensors)
    return {name: value for name, value in found.items() if name != "episodes"}  # they are given


def short(setup: Setup) -> Setup:
    """The same with small batches, that begins to learn soon and plays little for each update."""
    agent = replace(
        setup.agent,
        batch_size=BATCH_SIZE,
        learning_starts=LEARNING_STARTS,
        replay_capacity=CAPACITY,
        updates_per_transition=PACE,
    )
    return replace(setup, agent=agent)


def sums(first: Tensors, last: Tensors) -> Fingerprint:
    """Of all weights without their signs, and of how far they went."""

    def total(arrays: Iterable[npt.NDArray[Any]]) -> float:
        return math.fsum(float(np.abs(one.astype(np.float64)).sum()) for one in arrays)

    moved = (last[name].astype(np.float64) - first[name] for name in last)
    return {"weights": total(last.values()), "moved": total(moved)}
