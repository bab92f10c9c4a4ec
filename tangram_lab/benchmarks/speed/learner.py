"""Updates: compiled, and on a GPU."""

from functools import partial
from typing import cast

import numpy as np
import torch

from tangram_agent.agents.pair.batch import make_pairs
from tangram_agent.agents.pair.learner import PairLearner
from tangram_agent.base.ddpg import Ddpg
from tangram_core.errors import ConfigError
from tangram_core.setup import Setup
from tangram_lab.benchmarks.measure import Bound, Row, Work, compare, compared, rates
from tangram_lab.benchmarks.setups import preset, random_transitions, several, with_agent

BATCHES = (64, 256)


def measure_learner(runs: int) -> list[Row]:
    """Updates per second on one core, compiled, against single operations that do the same."""
    cases = [("perceptron [64, 64]", preset("mlp"), 256, 2.3)]
    cases += [("ours", preset(), size, 1.5) for size in BATCHES]
    cases += [("ours, 7 tokens", several(7), BATCHES[0], 1.5)]
    rows = []
    for name, setup, size, least in cases:
        made = with_agent(setup, batch_size=size)
        whole = updates(made, learner(made, compiled=True))
        given = ("learner", f"{name}, batch {size}, compiled", "updates/s"), whole
        rows.append(compare(*given, ("single operations", updates(made)), runs, Bound(least)))
    return rows


def measure_gpu(runs: int) -> list[Row]:
    """Updates per second on a GPU: recorded, compiled, and against one core, compiled.

    Raises:
        ConfigError: there is no GPU.
    """
    if not torch.cuda.is_available():
        raise ConfigError("gpu needs a GPU, and none is visible: see tangram-bench learner")
    rows = []
    for name, made in gpu_cases().items():
        single = learner(made, "cuda")
        single._whole = single.step
        ways = {
            "ours": updates(made, learner(made, "cuda")),
            "single operations on it": updates(made, single),
            "compiled": updates(made, learner(made, "cuda", compiled=True)),
            "one core, compiled": updates(made, learner(made, compiled=True)),
        }
        found, labels = rates(ways, runs), ("gpu", f"{name}, recorded", "updates/s")
        for against, bound in zip([*ways][1:], (Bound(5.0), None, None), strict=True):
            rows.append(compared(labels, found["ours"], against, found[against], bound))
    return rows


def gpu_cases() -> dict[str, Setup]:
    """What is measured on a GPU, from small to large."""
    named = [("perceptron [64, 64]", preset("mlp"), 256), ("paper's MHA", preset("paper"), 64)]
    named += [("ours, 7 tokens", several(7), BATCHES[0])]
    named += [("ours", preset(), size) for size in (*BATCHES, 2048)]
    return {
        f"{name}, batch {size}": with_agent(made, batch_size=size) for name, made, size in named
    }


def learner(setup: Setup, device: str = "cpu", *, compiled: bool = False) -> Ddpg:
    """What learns in a setup."""
    return cast("Ddpg", setup.agent.learner(setup.task, 0, device, compiled=compiled))


def updates(setup: Setup, made: Ddpg | None = None) -> Work:
    """Updates on one batch; by single operations where no learner is given."""
    own, generator = made or learner(setup), np.random.default_rng(0)
    batch = random_transitions(setup, own.config.batch_size)
    steps = partial(own.steps, batch, generator)
    if isinstance(own, PairLearner):  # pairs are made before; that they become tensors counts
        pairs = make_pairs(batch, own.task.layout, own.config.hindsight, generator)
        steps = partial(own.steps_of, pairs)

    def work() -> int:
        own.learn(steps())
        return 1

    return work
