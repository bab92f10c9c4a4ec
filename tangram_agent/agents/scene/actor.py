"""Acting on whole scenes.

Legend: B environments.
"""

import numpy as np
import torch

from tangram_agent.agents.scene.networks import ActorNet
from tangram_agent.agents.scene.scenes import Scenes, next_token
from tangram_agent.base.acting import NetworkActor, tensor
from tangram_agent.base.config import ActorCriticConfig
from tangram_core.arrays import Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_sim.motion.actions import make_actions
from tangram_tasks.place import Place
from tangram_tasks.played import closed


class SceneActor(NetworkActor):
    """The next token in the set's order, by the actor's velocity."""

    def __init__(self, task: Place, config: ActorCriticConfig, network: ActorNet) -> None:
        super().__init__(network)
        self._task, self._config = task, config

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:  # noqa: ARG002
        """Actions (B, A), with Gaussian noise and a share of them uniform where it explores."""
        flags = tensor(closed(seen))
        token = next_token(flags)
        with torch.inference_mode():
            scenes = Scenes(tensor(seen["corners"]), flags, tensor(seen["goals"]), token)
            velocity, _ = self.network(scenes)
        stay, count = np.zeros(len(token), np.bool_), self._task.layout.tokens
        actions = make_actions(token.numpy(), velocity.numpy(), stay, count, self._task.sim)
        if explore is None:
            return actions
        for action, generator in zip(actions, explore, strict=True):
            velocity_of = action[-3:]
            if generator.random() < self._config.uniform_share:
                velocity_of[:] = generator.uniform(-1.0, 1.0, 3)
            else:
                velocity_of += self._config.noise * generator.standard_normal(3)
        return np.clip(actions, -1.0, 1.0)
