"""Updates: against a plain per-head attention, and against Stable-Baselines3's on the same MLP."""

import numpy as np

from tangram_agent.learner import Learner
from tangram_agent.setup import Setup
from tangram_lab.benchmarks.measure import Bound, Row, Work, compare
from tangram_lab.benchmarks.peers import compare_updates
from tangram_lab.benchmarks.plain import PlainLearner
from tangram_lab.benchmarks.replay import random_transitions
from tangram_lab.benchmarks.setups import preset, several, with_agent

BATCHES = (64, 256)


def measure_learner(runs: int) -> list[Row]:
    """Updates per second on one core."""
    rows = []
    bound = Bound(least=3.0)
    for name, setup in (("paper's MHA", preset("paper")), ("ours", preset()), ("7", several(7))):
        for size in BATCHES if name != "7" else BATCHES[:1]:
            case = f"{name if name != '7' else 'ours, 7 tokens'}, batch {size}"
            rows.append(_against_plain(case, with_agent(setup, batch_size=size), runs, bound))
    return rows + compare_updates("learner", runs)


def _against_plain(case: str, setup: Setup, runs: int, bound: Bound) -> Row:
    theirs = ("a plain per-head attention", updates(setup, PlainLearner(setup, 0)))
    return compare(("learner", case, "updates/s"), updates(setup), theirs, runs, bound)


def updates(setup: Setup, learner: Learner | None = None) -> Work:
    """Updates on one batch; of the project's own learner if none is given."""
    learner = learner or Learner(setup, 0)
    transitions = random_transitions(setup, setup.agent.batch_size)
    batch = learner.prepared(transitions, np.random.default_rng(0))

    def work() -> int:
        learner.update(batch)
        return 1

    return work
