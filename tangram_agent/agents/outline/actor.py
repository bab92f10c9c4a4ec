"""The actor for outlines: it plays the place after which the rest is most likely to be filled.

Legend: B environments, G rows of an outline.
"""

import numpy as np

from tangram_agent.agents.outline.agent import OutlineConfig
from tangram_agent.agents.outline.filler import Filler
from tangram_agent.agents.outline.filling import Filling
from tangram_agent.agents.outline.values import OutlineValue
from tangram_agent.base.acting import NetworkActor
from tangram_agent.base.config import NetConfig
from tangram_core.arrays import Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_sim.motion.actions import make_actions
from tangram_tasks.fill import Fill
from tangram_tasks.played import closed


class OutlineActor(NetworkActor):
    """Chooses a token and its place by a `Filler`."""

    def __init__(self, task: Fill, config: OutlineConfig, net: NetConfig) -> None:
        super().__init__(OutlineValue(Filling(task.layout).shapes, net))
        self._task, self._config = task, config
        self._filler = Filler(self.network, task)

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:  # noqa: ARG002
        """Actions (B, A) for outlines (B, G, 2); while exploring, a share takes random places."""
        generators, share = explore or (), self._config.uniform_share
        drawn = [generator.random() < share for generator in generators]
        corners = np.asarray(seen["corners"], np.float64)
        anything = np.array(drawn) if drawn else np.zeros(len(corners), np.bool_)
        exact = corners, np.asarray(closed(seen), np.bool_)
        wanted = np.asarray(seen["goals"], np.float64)
        choice = self._filler.choose(*exact, wanted, anything, generators)
        count, sim = self._task.layout.tokens, self._task.sim
        return make_actions(choice.token, choice.velocity, choice.flip, count, sim)
