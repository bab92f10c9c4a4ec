"""The actor on whole scenes.

Legend: B environments.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.agents.scene.agent import SceneConfig
from tangram_agent.agents.scene.networks import ActorNet
from tangram_agent.agents.scene.scenes import whole
from tangram_agent.base.acting import NetworkActor, as_actions, tensor
from tangram_core.arrays import Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_tasks.place import Place
from tangram_tasks.played import closed


class Decision(nn.Module):
    """Network from the task's fields, by name, to actions (B, A) without exploration."""

    def __init__(self, task: Place, network: nn.Module) -> None:
        super().__init__()
        self._task, self.network = task, network

    def forward(self, seen: Mapping[str, Tensor]) -> Tensor:
        """Actions (B, A) for fields (B, ...) with the names of `Place.spec`."""
        scenes = whole(seen)
        return as_actions(scenes.token, None, self.network(scenes)[0], self._task)


class SceneActor(NetworkActor):
    """Moves the next token in the set's order by the velocity of the actor network."""

    def __init__(self, task: Place, config: SceneConfig, network: ActorNet) -> None:
        super().__init__(network)
        self._task, self._config = task, config

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:  # noqa: ARG002
        """Actions (B, A); while exploring, with Gaussian noise and a share of them uniform."""
        shown = {"placed": closed(seen), "corners": seen["corners"], "goals": seen["goals"]}
        with torch.inference_mode():
            scenes = whole({name: tensor(array) for name, array in shown.items()})
            velocity, raw = self.network(scenes)
            if explore is not None:
                velocity = torch.from_numpy(self._explored(velocity.numpy(), raw.numpy(), explore))
            return np.asarray(as_actions(scenes.token, None, velocity, self._task).numpy())

    def graph(self) -> "Decision":
        """The actor network, from fields to actions."""
        return Decision(self._task, self.network)

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
