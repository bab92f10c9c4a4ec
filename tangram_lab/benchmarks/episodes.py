"""Episodes that were really played, for measurements that send or keep them again and again."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np

from tangram_agent.setup import Setup
from tangram_agent.types import Episodes
from tangram_sim.arrays import Bools, Floats, Singles
from tangram_sim.batch import BatchedEnv
from worker.rollout import Rollout

ENVS = 32


def played(setup: Setup, count: int) -> Episodes:
    """Episodes of random actions, without an engine; `count` is a multiple of ENVS."""

    def choose(
        _corners: Floats, _placed: Bools, _goals: Floats, generators: Sequence[np.random.Generator]
    ) -> Singles:
        rows = [generator.uniform(-1.0, 1.0, setup.action_size) for generator in generators]
        return np.array(rows, np.float32)

    sim = replace(setup.sim, backend="kinematic")
    with closing(BatchedEnv(setup.layout, sim, setup.reward, ENVS)) as env:
        rollout = Rollout(env, 0, "player", 0, 0)
        return rollout.play(choose, count // ENVS)
