"""Acting on pairs: the best of what is proposed for each of them.

Legend: B environments, K tokens, A entries of an action.
"""

import numpy as np

from tangram_agent.agents.pair.agent import PairConfig
from tangram_agent.agents.pair.networks import Networks
from tangram_agent.agents.pair.planning import Planner
from tangram_agent.base.acting import NetworkActor
from tangram_agent.base.config import NetConfig
from tangram_agent.base.types import Choice
from tangram_core.arrays import Floats, Singles
from tangram_core.spec import Array, Arrays
from tangram_core.task import Generators, History
from tangram_sim.motion.actions import make_actions, velocities_of
from tangram_tasks.place import Place
from tangram_tasks.played import closed


class PairActor(NetworkActor):
    """Chooses token, side and pose by a `Planner`."""

    def __init__(self, task: Place, config: PairConfig, net: NetConfig) -> None:
        networks = Networks(task.layout, task.sim.arena, net)
        super().__init__(networks)
        self._task, self._config = task, config
        self._critic_plays = critic_plays(task)
        self._planner = Planner(networks, task, config.reapply)

    def needs(self, name: str) -> bool:
        """Not the critic, where there is one proposal and nothing to choose."""
        return self._critic_plays or not name.startswith("critic.")

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:  # noqa: ARG002
        """Actions (B, A), noisy or anything at all where it explores."""
        corners, goals = (np.asarray(seen[name], np.float64) for name in ("corners", "goals"))
        flags = np.asarray(closed(seen), np.bool_)
        actions = self._actions(self._planner.choose(corners, flags, goals))
        if explore is None:
            return actions
        for i, (action, generator) in enumerate(zip(actions, explore, strict=True)):
            if generator.random() < self._config.uniform_share:
                here = self._task.layout.poses(corners[i])
                action[:] = self._anything(here, flags[i], generator)
            else:
                action[-3:] += self._config.noise * generator.standard_normal(3)
        return np.clip(actions, -1.0, 1.0)

    def _actions(self, choice: Choice) -> Singles:
        """Actions (B, A) of what is chosen."""
        count, sim = self._task.layout.tokens, self._task.sim
        return make_actions(choice.token, choice.velocity, choice.flip, count, sim)

    def _anything(self, here: Floats, flags: Array, generator: np.random.Generator) -> Singles:
        """An action (A,): any token that is left goes to any pose in the arena, on any side.

        Args:
            here: (K, 3) poses of the tokens.
            flags: (K,) which are placed; where all are, the first one is named.
            generator: draws it.
        """
        sim = self._task.sim
        left = np.flatnonzero(~flags)
        token = int(generator.choice(left)) if len(left) else 0
        wanted = generator.uniform(-1.0, 1.0, 3) * (sim.arena / 2.0, sim.arena / 2.0, np.pi)
        flip = sim.allow_flip and generator.choice((-1.0, 1.0)) > 0.0
        way = velocities_of(wanted[None] - here[None, token], sim).astype(np.float32)
        velocity = np.clip(way, -1.0, 1.0)
        action: Singles = self._actions(Choice(np.array([token]), np.array([flip]), velocity))[0]
        return action


def critic_plays(task: Place) -> bool:
    """Whether the critic has a say in what is played; else the actor alone decides.

    Of one token that stays on its side there is one proposal, and nothing to choose.
    """
    return task.layout.tokens > 1 or task.sim.allow_flip
