"""The learner for several tokens: DDPG on pairs of a token and a piece of the target.

What an action is worth falls apart into what it covers of each piece, and hindsight knows the
geometry: so the critic learns a value for each pair, and the value of an action is their sum. What
lifted tokens cover stays covered, so all of it is earned at once. Tokens that slide push others out
of their places: the critic learns that for each pair of tokens, and whoever acts subtracts it, for
later actions with the weight gamma (see `pair_damage`). Nothing is bootstrapped.

Legend: M pairs.
"""

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.ddpg import Batch, Learner, saturation
from tangram_agent.pair_batch import make_pairs, with_contacts
from tangram_agent.pair_networks import PairNetworks
from tangram_agent.pairs import PairGraph, Pairs
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions


class PairLearner(Learner):
    """See `Learner`; workers get actor and critic."""

    def __init__(self, setup: Setup, seed: int, device: str = "cpu") -> None:
        self._layout, self._contacts = setup.layout, setup.contacts
        super().__init__(setup, seed, device)

    def make_networks(self, setup: Setup) -> tuple[nn.Module, nn.Module]:
        """Actor and critic."""
        graph = PairGraph(setup.layout, setup.sim.arena)
        self._networks = PairNetworks(graph, setup.net, setup.contacts)
        return self._networks.actor, self._networks.critic

    def playing(self) -> nn.Module:
        """Both networks: the critic chooses among what the actor proposes."""
        return self._networks

    def prepared(self, batch: Transitions, generator: np.random.Generator) -> Batch:
        """Pairs of the transitions, a share of them in hindsight."""
        pairs = make_pairs(batch, self.config, self._layout, generator)
        if self._contacts:
            return with_contacts(pairs, batch, self._layout, generator)
        return pairs

    def look(self, t: dict[str, Tensor]) -> None:
        """Indices are whole numbers."""
        for name in {"token", "piece", "other"} & t.keys():
            t[name] = t[name].long()

    def critic_loss(self, t: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Mean squared error of the values (M,), and the values."""
        q = self.critic(_pairs(t, "after"))
        loss = (q - t["value"]).square().mean()
        if self._contacts:
            loss = loss + self._pushed(t)
        return loss, q

    def _pushed(self, t: dict[str, Tensor]) -> Tensor:
        """Mean squared error of what tokens that slide push away."""
        share = self._networks.critic.pushed(_others(t), t["after"])
        return (share - t["pushed"]).square().mean()

    def actor_loss(self, t: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Minus the value of the actor's own poses, and the saturation penalty."""
        pairs = _pairs(t, "start")
        pose, raw = self.actor(pairs)
        return -self.critic(pairs.at(pose)).mean(), saturation(raw, self.config.saturation_limit)


def make_learner(setup: Setup, seed: int, device: str = "cpu") -> Learner:
    """The learner of a setup's agent."""
    return (PairLearner if setup.pairs else Learner)(setup, seed, device)


def _others(t: dict[str, Tensor]) -> Pairs:
    """The tokens where they were, each with another one in the place of a piece."""
    return Pairs(
        pose=t["before"],
        flipped=t["before_flipped"],
        token=t["token"],
        goal=t["other_pose"],
        goal_flipped=t["other_flipped"],
        piece=t["other"],
        covered=torch.zeros_like(t["covered"]),
    )


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
