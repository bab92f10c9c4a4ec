"""A fixed set of test episodes, played with noise off and the camera on."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.types import Past
from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.seeding import episode_generator
from worker.play.looking import environments
from worker.play.rollout import Choose, Generators, Played, play
from worker.score.metrics import summarise


def greedy(policy: Policy) -> Choose:
    """The policy without exploration noise."""

    def choose(
        corners: Floats, placed: Bools, goals: Floats, _generators: Generators, past: Past
    ) -> Singles:
        return policy.act(corners, placed, goals, past=past)

    return choose


PIXELS = 64  # of a picture's side, where training takes none


class FixedTests:
    """Test episodes that are the same whoever plays them.

    Attributes:
        setup: the task; its camera is on here, whether or not it is while training, but where
            outlines are shown.
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
        shown = setup.sim.observe == "silhouette"  # and no camera
        pixels = setup.sim.pixels or (0 if shown else PIXELS)
        self.setup = replace(setup, sim=replace(setup.sim, pixels=pixels))
        self._episodes = episodes
        self._set = (seed, role, 0, 0)
        self.env = environments(self.setup, min(at_once, episodes))

    def play(self, choose: Choose, go_on: Callable[[], bool] = lambda: True) -> Played:
        """All episodes, fewer if `go_on` says so; see `rollout.play`."""

        def generator(number: int) -> np.random.Generator:
            return episode_generator(*self._set, number)

        return play(self.env, choose, generator, self._episodes, go_on=go_on)

    def scores(self, played: Played) -> dict[str, float]:
        """See `worker.score.metrics.summarise`."""
        reward = self.setup.reward
        own_reward = (reward.name, reward.source) != ("overlap", "polygon")
        return summarise(self.setup.layout, self.setup.sim, played, own_reward)

    def close(self) -> None:
        """Close the environments."""
        self.env.close()
