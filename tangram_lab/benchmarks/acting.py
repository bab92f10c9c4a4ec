"""The policy: batches against one at a time, and its share of a worker's time."""

import time
from contextlib import closing
from typing import Any

import numpy as np

from tangram_agent.config import ServiceConfig
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_lab.benchmarks.measure import Bound, Row, Work, compare, single
from tangram_lab.benchmarks.setups import preset, several, with_sim
from tangram_sim.arrays import Singles
from tangram_sim.batch import BatchedEnv
from worker.rollout import Rollout

BATCH = 32
EPISODES = 512


def measure_acting(runs: int) -> list[Row]:
    """Actions per second in batches of 32, and how much of its time a worker spends on them."""
    rows = []
    for case, setup in (("1 token", preset()), ("7 tokens", several(7))):
        labels = ("acting", f"{case}, batches of {BATCH}", "actions/s")
        one = ("one at a time", act(setup, 1))
        rows.append(compare(labels, act(setup, BATCH), one, runs, Bound(least=8.0)))
    for pixels in (128, 64, 0):
        pictures = f"pictures of {pixels} px" if pixels else "no pictures"
        shares, speeds = zip(
            *(_worker(with_sim(preset(), pixels=pixels)) for _ in range(runs)), strict=True
        )
        labels = ("acting", f"share of a worker's time, {pictures}", "share")
        rows.append(single(labels, shares, Bound(most=0.2)))
        labels = ("acting", f"a worker's play, {pictures}", "episodes/s")
        rows.append(single(labels, speeds))
    return rows


def act(setup: Setup, count: int) -> Work:
    """Actions for so many environments at a time, all at their start."""
    policy = Policy(setup)
    with closing(BatchedEnv(setup.layout, setup.sim, setup.reward, count)) as env:
        env.reset([np.random.default_rng(number) for number in range(count)])
    return lambda: len(policy.act(env.seen, env.placed, env.seen_goals))


class _Clocked:
    """A policy that adds up the time of its answers."""

    def __init__(self, setup: Setup) -> None:
        self.policy, self.spent_s = Policy(setup), 0.0

    def __call__(self, *state: Any) -> Singles:
        begin = time.perf_counter()
        actions = self.policy.explore(*state)
        self.spent_s += time.perf_counter() - begin
        return actions


def _worker(setup: Setup) -> tuple[float, float]:
    """The share of acting in a worker's time, and its episodes in a second."""
    choose = _Clocked(setup)
    env = BatchedEnv(setup.layout, setup.sim, setup.reward, ServiceConfig().envs)
    with closing(env):
        rollout = Rollout(env, 0, "player", 0, 1)
        rollout.play(choose)
        first, choose.spent_s, begin = rollout.episode, 0.0, time.perf_counter()
        while rollout.episode < EPISODES:
            rollout.play(choose)
        passed = time.perf_counter() - begin
        return choose.spent_s / passed, (rollout.episode - first) / passed
