"""Fingerprints of the code that trains: what 20 updates in lockstep come to, for each training.

Figures stay true while a training comes to the same numbers as when they were made, whatever else
of the code has changed. Those numbers are made in a process of their own, whose arithmetic is the
same on an Intel and on an AMD; x86-64 with AVX2 is what it takes.
"""

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import track

from master.children import describe, environment
from master.console import sturdy_console
from master.trainer import Trainer
from tangram_agent.learner import NotFiniteError
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup, make_setup
from tangram_sim.errors import RunError
from worker.looking import environments
from worker.rollout import Rollout
from worker.test_set import FixedTests, greedy

UPDATES = 20
BATCH_SIZE, LEARNING_STARTS, CAPACITY, PACE = 16, 16, 256, 2.0  # instead of the agent's
SEED, ENVS, BATCH_EPISODES, TEST_EPISODES = 0, 4, 4, 4
TOLERANCE = 1e-6
# Libraries choose kernels by the processor, and each rounds otherwise: 20 updates of six in 63
# trainings came to other scores on an Intel than on an AMD. With these both come to the same.
KERNELS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OPENBLAS_CORETYPE": "HASWELL",
    "MKL_CBWR": "COMPATIBLE",  # nothing faster is the same on processors of both makers
    "ATEN_CPU_CAPABILITY": "avx2",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4,AVX512_ICL,AVX512_SPR",
    "OPENCV_CPU_DISABLE": "AVX512-SKX",
    "OPENCV_IPP": "disabled",
}

Fingerprint = dict[str, float]
Tensors = Mapping[str, npt.NDArray[Any]]


def make_fingerprints(configs: Mapping[str, Mapping[str, Any]]) -> dict[str, Fingerprint]:
    """Training -> what it comes to by the code as it is; nothing where that is not finite.

    Args:
        configs: training -> its whole config.

    Raises:
        ConfigError: this code refuses a training.
        RunError: the process that makes them failed.
    """
    for config in configs.values():
        make_setup(config)
    if not configs:
        return {}
    console = sturdy_console(sys.stderr)
    told = f"{UPDATES} updates of each training"
    with TemporaryFile() as asked, TemporaryFile() as errors:
        asked.write(json.dumps(configs).encode())
        asked.seek(0)
        command = [sys.executable, "-P", "-m", "tangram_lab.experiments.fingerprints"]
        with subprocess.Popen(
            command, stdin=asked, stdout=subprocess.PIPE, stderr=errors, env=environment() | KERNELS
        ) as process:
            made = track(process.stdout or (), told, len(configs), console=console, transient=True)
            lines = list(made)
        if process.returncode:
            errors.seek(0)
            why = errors.read().decode(errors="replace").strip().rpartition("\n")[2]
            raise RunError(f"no fingerprint could be made: {why or describe(process.returncode)}")
    found = dict[str, Fingerprint](json.loads(line) for line in lines)
    if found.keys() != configs.keys():
        raise RunError(f"fingerprints of {len(found)} of {len(configs)} trainings were made")
    return found


def main() -> None:
    """Trainings and their configs from stdin; a line with the name and the numbers of each."""
    torch.set_num_threads(1)
    lines = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever else prints, as a reward of one's own may
    known = dict[Setup, Fingerprint]()
    for name, config in json.load(sys.stdin).items():
        setup = short(make_setup(config))
        if setup not in known:
            try:
                known[setup] = make_fingerprint(setup)
            except NotFiniteError:
                known[setup] = {}
        lines.write(json.dumps((name, known[setup])) + "\n")
        lines.flush()


def make_facts(config: Mapping[str, Any]) -> dict[str, Any]:
    """What the result of every run of a training tells of its task and its agent.

    Args:
        config: the training's whole config.

    Raises:
        ConfigError: this code refuses it.
    """
    facts = Trainer(short(make_setup(config)), SEED, "cpu").facts()
    return {name: fact for name, fact in facts.items() if name != "device"}


def differences(before: Fingerprint, now: Fingerprint) -> list[str]:
    """The numbers that are not what they were."""
    return [
        f"{name} is {now.get(name)}, and was {before.get(name)}"
        for name in {**now, **before}
        if not np.isclose(
            before.get(name, np.nan), now.get(name, np.nan), rtol=TOLERANCE, atol=TOLERANCE
        )
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


if __name__ == "__main__":
    main()
