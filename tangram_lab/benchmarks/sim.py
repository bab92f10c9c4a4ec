"""The simulation against a bare PyBullet loop with the same steps and pictures."""

from contextlib import closing

import numpy as np

from tangram_agent.config import ServiceConfig
from tangram_agent.setup import Setup
from tangram_lab.benchmarks.bullet import BareLoop
from tangram_lab.benchmarks.measure import Bound, Row, compare
from tangram_lab.benchmarks.setups import preset, several, with_sim
from tangram_sim.batch import BatchedEnv
from tangram_sim.seeding import episode_generator

ENVS = ServiceConfig().envs
PIXELS = (64, 128)
TARGET = Bound(least=0.85)


def measure_sim(runs: int) -> list[Row]:
    """Episodes per second: drawn, played, photographed and rewarded, against the engine alone."""
    rows = []
    for count, setup in ((1, preset()), (7, several(7))):
        for pixels in PIXELS:
            case = f"{_tokens(count)}, {pixels} px"
            rows.append(_row(case, with_sim(setup, camera=True, pixels=pixels), runs, TARGET))
        rows.append(_row(f"{_tokens(count)}, no pictures", with_sim(setup, camera=False), runs))
    return rows


def _tokens(count: int) -> str:
    return "1 token" if count == 1 else f"{count} tokens"


def _row(case: str, setup: Setup, runs: int, bound: Bound | None = None) -> Row:
    labels = ("sim", case, "episodes/s")
    with closing(Episodes(setup)) as ours, closing(_bare(setup)) as bare:
        return compare(labels, ours.play, ("bare PyBullet", bare.play), runs, bound)


def _bare(setup: Setup) -> BareLoop:
    return BareLoop(setup.layout, setup.sim, setup.horizon)


class Episodes:
    """Whole episodes with actions drawn beforehand, as many at a time as a worker plays."""

    def __init__(self, setup: Setup) -> None:
        self.env = BatchedEnv(setup.layout, setup.sim, setup.reward, ENVS)
        rng = np.random.default_rng(0)
        self.actions = rng.uniform(-0.5, 0.5, (setup.horizon, ENVS, setup.action_size))
        if setup.layout.tokens > 1:
            moved = (2.0 * np.arange(setup.horizon) + 1.0) / setup.horizon - 1.0
            self.actions[..., 0] = moved[:, None]
        self.number = 0

    def close(self) -> None:
        """Free the engines."""
        self.env.close()

    def play(self) -> int:
        """One episode in every environment."""
        first, self.number = self.number, self.number + ENVS
        numbers = range(first, first + ENVS)
        self.env.reset([episode_generator(0, "player", 0, 1, number) for number in numbers])
        for actions in self.actions:
            self.env.step(actions)
        return ENVS
