"""How much one core does in a second, stage by stage.

Every rate is the median of several measurements of at least `SPAN_S`; the table gives the smallest
and the largest beside it. Compare rates of one table with each other, not across machines.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

import conf
from benchmarks.report import show, write
from tangram_agent.config import ServiceConfig
from tangram_agent.ddpg import Learner
from tangram_agent.hindsight import with_twins
from tangram_agent.policy import Policy
from tangram_agent.replay import ReplayBuffer
from tangram_agent.setup import SECTIONS, Setup, make_setup
from tangram_sim.batch import BatchedEnv
from tangram_sim.rewards import make_reward
from worker.rollout import Rollout

SPAN_S = 0.5
ENVS = ServiceConfig().envs


def measure_rates(runs: int, out: Path | None) -> None:
    torch.set_num_threads(1)
    rows = []
    for stage, unit, work in _stages():
        rates = [_rate(work) for _ in range(runs)]
        row = {"stage": stage, "unit": unit, "median": statistics.median(rates)}
        rows.append(row | {"least": min(rates), "most": max(rates)})
    show("Rates on one core", rows)
    write(out, {"runs": runs, "rates": rows})


def _rate(work: Callable[[], int]) -> float:
    """Things done in a second, over at least SPAN_S."""
    work()
    begin, count = time.perf_counter(), 0
    while (passed := time.perf_counter() - begin) < SPAN_S:
        count += work()
    return count / passed


def _stages() -> list[tuple[str, str, Callable[[], int]]]:
    tangram, paper, mlp = (preset(name) for name in ("tangram", "paper", "mlp"))
    pixels = (64, 128)
    return [
        ("play, kinematic", "episodes/s", _play(with_sim(tangram, backend="kinematic"))),
        ("play, physics", "episodes/s", _play(tangram)),
        *(
            (
                f"play, physics, pictures of {side} px",
                "episodes/s",
                _play(with_sim(tangram, camera=True, pixels=side)),
            )
            for side in pixels
        ),
        ("act, tangram, batches of 32", "actions/s", _act(tangram, ENVS)),
        ("act, tangram, one at a time", "actions/s", _act(tangram, 1)),
        ("hindsight and insert", "transitions/s", _insert(tangram)),
        ("sample batches of 256", "transitions/s", _sample(tangram)),
        ("update, tangram, batch 64", "updates/s", _update(tangram)),
        ("update, paper's MHA, batch 256", "updates/s", _update(paper)),
        ("update, paper's MLP, batch 256", "updates/s", _update(mlp)),
    ]


def preset(agent: str) -> Setup:
    """The setup of an agent's preset on the single square, read from the config's files."""
    folder = Path(conf.__file__).parent

    def group(name: str, choice: str) -> dict[str, Any]:
        content = yaml.safe_load((folder / name / f"{choice}.yaml").read_text())
        return {key: value for key, value in content.items() if key != "defaults"}

    agent_file = yaml.safe_load((folder / "agent" / f"{agent}.yaml").read_text())
    (net,) = (
        value
        for line in agent_file["defaults"]
        if isinstance(line, dict)
        for value in line.values()
    )
    choices = dict(zip(SECTIONS, ("square", "physics", "overlap", agent, net), strict=True))
    return make_setup({name: group(name, choice) for name, choice in choices.items()})


def with_sim(setup: Setup, **values: Any) -> Setup:
    return replace(setup, sim=replace(setup.sim, **values))


def _play(setup: Setup) -> Callable[[], int]:
    env = BatchedEnv(setup.layout, setup.sim, setup.reward, ENVS)
    rollout = Rollout(env, 0, "player", 0, 1)
    policy = Policy(setup)
    return lambda: rollout.play(policy.explore).count


def _act(setup: Setup, count: int) -> Callable[[], int]:
    policy, rng = Policy(setup), np.random.default_rng(0)
    corners, goals = rng.uniform(-1, 1, (2, count, setup.layout.corner_count, 2))
    placed = np.zeros((count, 1), dtype=np.bool_)
    return lambda: len(policy.act(corners, placed, goals))


def _filled(setup: Setup) -> tuple[ReplayBuffer, Callable[[], int]]:
    """A replay buffer and the work of one more batch with its twins."""
    env = BatchedEnv(setup.layout, setup.sim, setup.reward, ENVS)
    episodes = Rollout(env, 0, "player", 0, 1).play(Policy(setup).explore)
    reward = make_reward(setup.reward, setup.layout, setup.sim)
    replay = ReplayBuffer(10_000, setup.layout.corner_count, 1, setup.action_size)
    rng = np.random.default_rng(0)

    def insert() -> int:
        batch = with_twins(episodes, setup.agent.hindsight, setup.layout, reward, rng)
        replay.add(batch)
        return batch.count

    insert()
    return replay, insert


def _insert(setup: Setup) -> Callable[[], int]:
    return _filled(setup)[1]


def _sample(setup: Setup) -> Callable[[], int]:
    replay, rng = _filled(setup)[0], np.random.default_rng(0)
    return lambda: replay.sample(256, rng).count


def _update(setup: Setup) -> Callable[[], int]:
    replay, rng = _filled(setup)[0], np.random.default_rng(0)
    learner = Learner(setup, seed=0)

    def update() -> int:
        learner.update(replay.sample(setup.agent.batch_size, rng))
        return 1

    return update
