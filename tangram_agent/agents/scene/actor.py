"""Acting on whole scenes.

Legend: B environments.
"""

import numpy as np
import torch

from tangram_agent.agents.scene.agent import SceneConfig
from tangram_agent.agents.scene.networks import ActorNet
from tangram_agent.agents.scene.scenes import Scenes, next_token
from tangram_agent.base.acting import NetworkActor, tensor
from tangram_core.arrays import Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_sim.motion.actions import make_actions
from tangram_tasks.place import Place
from tangram_tasks.played import closed


class SceneActor(NetworkActor):
    """The next token in the set's order, by the actor's velocity."""

    def __init__(self, task: Place, config: SceneConfig, network: ActorNet) -> None:
        super().__init__(network)
        self._task, self._config = task, config

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:  # noqa: ARG002
        """Actions (B, A), with Gaussian noise and a share of them uniform where it explores."""
        flags = tensor(closed(seen))
        token = next_token(flags)
        with torch.inference_mode():
            scenes = Scenes(tensor(seen["corners"]), flags, tensor(seen["goals"]), token)
            velocity, raw = (one.numpy() for one in self.network(scenes))
        if explore is not None:
            velocity = self._explored(velocity, raw, explore)
        stay, count = np.zeros(len(token), np.bool_), self._task.layout.tokens
        return make_actions(token.numpy(), velocity, stay, count, self._task.sim)

    def _explored(self, velocity: Singles, raw: Singles, explore: Generators) -> Singles:
        """Velocities (B, 3) with noise, before the last tanh or after it; some are uniform."""
        config, rows = self._config, []
        for own, before, generator in zip(velocity, raw, explore, strict=True):
            if generator.random() < config.uniform_share:
                rows.append(generator.uniform(-1.0, 1.0, 3))
                continue
            noise = config.noise * generator.standard_normal(3)
            rows.append(np.tanh(before + noise) if config.noise_inside else own + noise)
        explored: Singles = np.clip(np.stack(rows), -1.0, 1.0).astype(np.float32)
        return explored
