"""The losses of DDPG, TD3 and SAC.

Legend: B transitions, C critics.
"""

from collections.abc import Iterator
from typing import cast

import torch
from torch import Tensor, nn

from tangram_agent.agents.goal.agent import GoalConfig
from tangram_agent.agents.goal.gaussian import GaussianPolicy, Temperature
from tangram_agent.flat.actor_critic import ActorCritic, Batch, Loss
from tangram_agent.flat.networks import Critics

SMOOTHING, MOST_SMOOTHED = 0.2, 0.5  # size and bound of target noise: Fujimoto et al. 2018


class GoalLearner(ActorCritic[GoalConfig]):
    """Learner of the algorithm in the settings.

    Target networks follow in every update; the TD3 paper moves them only with the actor.
    """

    draws = 2

    def modules(self) -> dict[str, nn.Module]:
        """The critics, and the temperature for SAC."""
        config = self.config
        count = 1 if config.algorithm == "ddpg" else 2
        self.critic = Critics(self.size, self.actions, config, count)
        if config.algorithm == "td3":
            self.delay = config.actor_delay
        if config.algorithm != "sac":
            return {"critic": self.critic}
        self.temperature = Temperature()
        return {"critic": self.critic, "temperature": self.temperature}

    def target_names(self) -> tuple[str, ...]:
        """Names of the networks that have a target network; for SAC only the critics."""
        return ("critic",) if self.config.algorithm == "sac" else ("actor", "critic")

    def losses(self, batch: Batch) -> Iterator[Loss]:
        """Yield the loss of the critics, then those of the actor and the temperature."""
        with torch.no_grad():
            target = self._target(batch)
        values = self.critic(batch.rows, batch.actions)
        yield Loss("critic", (values - target).square().mean(1).sum(), {"q": values.mean()})
        if not batch.acts:
            return
        if self.config.algorithm == "sac":
            yield from self._entropic(batch)
            return
        actions = self.actor(batch.rows)
        value = self.critic.one(0, batch.rows, actions).mean()
        penalty = actions.square().mean()
        yield Loss("actor", self.config.action_penalty * penalty - value, {"effort": penalty})

    def _target(self, batch: Batch) -> Tensor:
        """(B,) y = r + gamma (1 - d) min Q'(s', a')."""
        config, following = self.config, batch.following
        bonus = batch.rewards.new_zeros(())
        if config.algorithm == "sac":
            actions, density = cast("GaussianPolicy", self.actor).drawn(following, batch.normals[0])
            bonus = self.temperature() * density
        else:
            actions = self.targets["actor"](following)
            if config.algorithm == "td3":
                noise = SMOOTHING * batch.normals[0]
                actions = actions + noise.clamp(-MOST_SMOOTHED, MOST_SMOOTHED)
                actions = actions.clamp(-1.0, 1.0)
        value = self.targets["critic"](following, actions).amin(0) - bonus
        target = batch.rewards + config.gamma * batch.goes_on * value
        # The entropy adds to the rewards, without a known bound.
        return target if config.algorithm == "sac" else self.bounded(target)

    def _entropic(self, batch: Batch) -> Iterator[Loss]:
        """SAC's actor, then its temperature (Haarnoja et al. 2018, equations 9 and 18)."""
        actions, density = cast("GaussianPolicy", self.actor).drawn(batch.rows, batch.normals[1])
        value = self.critic(batch.rows, actions).amin(0)
        penalty = actions.square().mean()
        worth = self.temperature().detach()
        loss = (worth * density - value).mean() + self.config.action_penalty * penalty
        yield Loss("actor", loss, {"effort": penalty, "entropy": -density.mean()})
        lacking = (density.detach().mean() - self.actions).detach()
        yield Loss("temperature", -self.temperature.logarithm * lacking, {"temperature": worth})
