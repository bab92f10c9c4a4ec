"""A fixed set of test episodes, played with noise off and the camera on."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from tangram_agent.policy import Policy
from tangram_agent.runs import Run
from tangram_agent.setup import Setup
from tangram_sim.arrays import Bools, Floats, Singles
from tangram_sim.batch import BatchedEnv
from tangram_sim.errors import ConfigError
from tangram_sim.seeding import episode_generator
from worker.metrics import summarise
from worker.rollout import Choose, Generators, Played, play


def greedy(policy: Policy) -> Choose:
    """The policy without exploration noise."""

    def choose(corners: Floats, placed: Bools, goals: Floats, _generators: Generators) -> Singles:
        return policy.act(corners, placed, goals)

    return choose


def with_actions(setup: Setup, actions: int | None) -> Setup:
    """The setup with another number of actions per token; None leaves it as it is.

    A policy does not know the length of an episode, so one that was trained on single actions can
    be tested on several, as in Table II.
    """
    if actions is None:
        return setup
    return replace(setup, sim=replace(setup.sim, actions_per_token=actions))


def with_corner_noise(setup: Setup, noise: float | None) -> Setup:
    """The setup with other noise on the corners that a policy sees; None leaves it as it is."""
    if noise is None:
        return setup
    return replace(setup, sim=replace(setup.sim, corner_noise=noise))


def adapted(run: Run, changes: Mapping[str, Any]) -> Run:
    """The run with other settings of its agent's play, the same weights; none leaves it as it is.

    Raises:
        ConfigError: the agent has no such choice, or a value is out of its range.
    """
    if not changes:
        return run
    if not run.setup.pairs:
        raise ConfigError(
            f"{', '.join(changes)}: the agent of {run.folder} has no such choice; leave it out, or "
            "name a run of several tokens with agent.readout=pair"
        )
    return run.with_agent(**changes)


class FixedTests:
    """Test episodes that are the same whoever plays them.

    Attributes:
        setup: the task; its camera is on here, whether or not it is while training.
        env: where they are played.
    """

    def __init__(
        self, setup: Setup, episodes: int, at_once: int, role: str = "evaluation", seed: int = 0
    ) -> None:
        """Open the environments.

        Args:
            episodes: size of the set; the first ones of a larger set are those of a smaller one.
            at_once: most episodes played at a time.
            role, seed: name the set; the defaults name `seeding.evaluation_generators`.
        """
        self.setup = replace(setup, sim=replace(setup.sim, camera=True))
        self._episodes = episodes
        self._set = (seed, role, 0, 0)
        self.env = BatchedEnv(setup.layout, self.setup.sim, setup.reward, min(at_once, episodes))

    def play(self, choose: Choose, go_on: Callable[[], bool] = lambda: True) -> Played:
        """All episodes, fewer if `go_on` says so; see `rollout.play`."""

        def generator(number: int) -> np.random.Generator:
            return episode_generator(*self._set, number)

        return play(self.env, choose, generator, self._episodes, go_on=go_on)

    def scores(self, played: Played) -> dict[str, float]:
        """See `worker.metrics.summarise`."""
        reward = self.setup.reward
        own_reward = (reward.name, reward.source) != ("overlap", "polygon")
        return summarise(self.setup.layout, self.setup.sim, played, own_reward)

    def close(self) -> None:
        """Close the environments."""
        self.env.close()
