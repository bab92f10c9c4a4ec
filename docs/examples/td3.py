"""TD3 from scratch (Fujimoto et al. 2018): its settings, its networks and its losses.

Replay, hindsight, normalised inputs, optimisers and checkpoints come with the base. Train it with:

    tangram-train agent=docs/examples/td3.py:TD3 task=gym task.id=PandaPush-v3 \
        task.imports=[panda_gym] task.fresh=true
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import nn

from tangram_agent.flat.actor_critic import ActorCritic, Loss
from tangram_agent.flat.agent import ActorCriticAgent
from tangram_agent.flat.config import BaseConfig
from tangram_core.settings import setting


@dataclass(frozen=True)
class TD3Config(BaseConfig, section="agent"):
    smoothing: float = setting(0.2, "deviation of the noise on actions in targets", low=0)
    delay: int = setting(2, "updates for each one of the actor", low=1)


class Twins(nn.Module):
    def __init__(self, inputs, width=256):
        super().__init__()
        self.first, self.second = (
            nn.Sequential(
                nn.Linear(inputs, width), nn.LayerNorm(width), nn.ReLU(),
                nn.Linear(width, width), nn.LayerNorm(width), nn.ReLU(),
                nn.Linear(width, 1),
            )
            for _ in range(2)
        )  # fmt: skip

    def forward(self, rows, actions):
        both = torch.cat([rows, actions], -1)
        return self.first(both)[:, 0], self.second(both)[:, 0]


class TD3Learner(ActorCritic):
    def modules(self):
        self.delay = self.config.delay
        self.critic = Twins(self.size + self.actions)
        return {"critic": self.critic}  # besides the actor

    def losses(self, batch):
        config = self.config
        with torch.no_grad():  # the target: smoothed action, lesser value
            noise = (config.smoothing * batch.normals[0]).clamp(-0.5, 0.5)
            actions = (self.targets["actor"](batch.following) + noise).clamp(-1, 1)
            value = torch.minimum(*self.targets["critic"](batch.following, actions))
            y = self.bounded(batch.rewards + config.gamma * batch.goes_on * value)
        first, second = self.critic(batch.rows, batch.actions)
        yield Loss("critic", (first - y).square().mean() + (second - y).square().mean())
        if batch.acts:
            actions = self.actor(batch.rows)
            value = self.critic(batch.rows, actions)[0].mean()
            yield Loss("actor", 0.1 * actions.square().mean() - value, {"q": value})


@dataclass(frozen=True)
class TD3(ActorCriticAgent):
    sections: ClassVar = {"agent": TD3Config}
    config: TD3Config = TD3Config()

    def learns(self):
        return TD3Learner
