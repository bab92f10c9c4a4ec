"""The learner for several tokens: DDPG on pairs of a token and a piece of the target.

What an action is worth falls apart into what it covers of each piece, and hindsight knows the
geometry: so the critic learns a value for each pair, and the value of an action is their sum. All
of it is earned at once, so there is no bootstrapping: gamma must be 0.

Legend: M pairs.
"""

import numpy as np
from torch import Tensor, nn

from tangram_agent.ddpg import Batch, Learner, saturation
from tangram_agent.pair_batch import make_pairs
from tangram_agent.pair_networks import PairNetworks
from tangram_agent.pairs import PairGraph, Pairs
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions


class PairLearner(Learner):
    """See `Learner`; workers get actor and critic."""

    def __init__(self, setup: Setup, seed: int, device: str = "cpu") -> None:
        self._layout = setup.layout
        super().__init__(setup, seed, device)

    def make_networks(self, setup: Setup) -> tuple[nn.Module, nn.Module]:
        """Actor and critic."""
        graph = PairGraph(setup.layout, setup.sim.arena)
        self._networks = PairNetworks(graph, setup.net)
        return self._networks.actor, self._networks.critic

    def playing(self) -> nn.Module:
        """Both networks: the critic chooses among what the actor proposes."""
        return self._networks

    def prepared(self, batch: Transitions, generator: np.random.Generator) -> Batch:
        """Pairs of the transitions, a share of them in hindsight."""
        return make_pairs(batch, self.config, self._layout, generator)

    def look(self, t: dict[str, Tensor]) -> None:
        """Indices are whole numbers."""
        for name in ("token", "piece"):
            t[name] = t[name].long()

    def critic_loss(self, t: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Mean squared error of the values (M,), and the values."""
        q = self.critic(_pairs(t, "after"))
        return (q - t["value"]).square().mean(), q

    def actor_loss(self, t: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Minus the value of the actor's own poses, and the saturation penalty."""
        pairs = _pairs(t, "before")
        pose, raw = self.actor(pairs)
        return -self.critic(pairs.at(pose)).mean(), saturation(raw, self.config.saturation_limit)


def make_learner(setup: Setup, seed: int, device: str = "cpu") -> Learner:
    """The learner of a setup's agent."""
    return (PairLearner if setup.pairs else Learner)(setup, seed, device)


def _pairs(t: dict[str, Tensor], when: str) -> Pairs:
    return Pairs(
        pose=t[when],
        flipped=t[f"{when}_flipped"],
        token=t["token"],
        goal=t["goal"],
        goal_flipped=t["goal_flipped"],
        piece=t["piece"],
        covered=t["covered"],
    )
