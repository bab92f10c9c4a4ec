"""The actor for pairs: it plays the best of the proposals for all pairs.

Legend: B environments, K tokens, A entries of an action.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.agents.pair.agent import PairConfig
from tangram_agent.agents.pair.networks import Networks
from tangram_agent.agents.pair.planning import Planner
from tangram_agent.base.acting import NetworkActor, as_actions
from tangram_agent.base.config import NetConfig
from tangram_core.arrays import Floats, Singles
from tangram_core.spec import Array, Arrays
from tangram_core.task import Generators, History
from tangram_sim.motion.actions import make_actions, velocities_of
from tangram_tasks.place import Place
from tangram_tasks.played import closed


class Decision(nn.Module):
    """Network from the task's fields, by name, to actions (B, A) without exploration."""

    def __init__(self, task: Place, planner: Planner) -> None:
        super().__init__()
        self._task, self.planner = task, planner

    def forward(self, seen: Mapping[str, Tensor]) -> Tensor:
        """Actions (B, A) for fields (B, ...) with the names of `Place.spec`."""
        corners, goals = seen["corners"].double(), seen["goals"].double()
        token, flip, velocity = self.planner(corners, closed(seen), goals)
        return as_actions(token, flip, velocity, self._task)


class PairActor(NetworkActor):
    """Chooses token, side and pose by a `Planner`."""

    def __init__(self, task: Place, config: PairConfig, net: NetConfig) -> None:
        networks = Networks(task.layout, task.sim.arena, net)
        super().__init__(networks)
        self._task, self._config = task, config
        self._critic_plays = critic_plays(task)
        self._decides = Decision(task, Planner(networks, task, config.reapply))

    def needs(self, name: str) -> bool:
        """Whether a parameter is needed to act; those of the critic only if `critic_plays`."""
        return self._critic_plays or not name.startswith("critic.")

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:  # noqa: ARG002
        """Actions (B, A); while exploring, with noise or drawn at random."""
        if not len(seen["corners"]):
            return np.zeros((0, self._task.spec.action_size), np.float32)
        corners, goals = (np.array(seen[name], np.float64) for name in ("corners", "goals"))
        flags = np.array(closed(seen), np.bool_)
        shown = {"corners": corners, "placed": flags, "goals": goals}
        with torch.no_grad():
            played = self._decides({name: torch.from_numpy(one) for name, one in shown.items()})
        actions: Singles = played.numpy()
        if explore is None:
            return actions
        for i, (action, generator) in enumerate(zip(actions, explore, strict=True)):
            if generator.random() < self._config.uniform_share:
                here = self._task.layout.poses(corners[i])
                action[:] = self._anything(here, flags[i], generator)
            else:
                action[-3:] += self._config.noise * generator.standard_normal(3)
        return np.clip(actions, -1.0, 1.0)

    def graph(self) -> "Decision":
        """The planner, as one network."""
        return self._decides

    def _anything(self, here: Floats, flags: Array, generator: np.random.Generator) -> Singles:
        """A random action (A,): any token that is left, to any pose in the arena, on any side.

        Args:
            here: (K, 3) poses of the tokens.
            flags: (K,) whether each token is placed; if all are, the first one moves.
            generator: draws the action.
        """
        sim = self._task.sim
        left = np.flatnonzero(~flags)
        token = int(generator.choice(left)) if len(left) else 0
        wanted = generator.uniform(-1.0, 1.0, 3) * (sim.arena / 2.0, sim.arena / 2.0, np.pi)
        flip = sim.allow_flip and generator.choice((-1.0, 1.0)) > 0.0
        way = velocities_of(wanted[None] - here[None, token], sim).astype(np.float32)
        velocity = np.clip(way, -1.0, 1.0)
        count = self._task.layout.tokens
        action: Singles = make_actions(np.array([token]), velocity, np.array([flip]), count, sim)[0]
        return action


def critic_plays(task: Place) -> bool:
    """Whether the critic takes part in acting; otherwise the actor decides alone.

    For one token that cannot be turned over there is one proposal, so there is no choice.
    """
    return task.layout.tokens > 1 or task.sim.allow_flip
