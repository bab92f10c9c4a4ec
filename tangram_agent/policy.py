"""Acting: a copy of the actor on the CPU, batched, with or without exploration noise.

Legend: B environments, K tokens, V corners, A entries of an action.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch

from tangram_agent.ddpg import next_token
from tangram_agent.graph import TokenGraph
from tangram_agent.networks import Actor
from tangram_agent.setup import Setup
from tangram_agent.types import Weights
from tangram_agent.weights import load_arrays
from tangram_sim.arrays import Floats, Singles

Flags = npt.NDArray[np.bool_] | npt.NDArray[np.uint8]


class Policy:
    """The actor as workers use it.

    Attributes:
        version: of the weights that are loaded; -1 before the first.
    """

    def __init__(self, setup: Setup) -> None:
        self.tokens, self.config = setup.layout.tokens, setup.agent
        self.version = -1
        graph = TokenGraph(setup.layout, setup.sim.arena, setup.agent)
        self._actor = Actor(graph, setup.agent, setup.net).requires_grad_(False)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the tensors that `load` accepts."""
        return {name: tuple(p.shape) for name, p in self._actor.named_parameters()}

    def load(self, weights: Weights) -> None:
        """Take over broadcast weights.

        Raises:
            RunError: they belong to another layout or network.
        """
        load_arrays(self._actor, weights.tensors)
        self.version = weights.version

    def act(self, corners: Floats | Singles, placed: Flags, goals: Floats | Singles) -> Singles:
        """Actions (B, A) in [-1, 1], noise off.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) which tokens are placed.
            goals: (B, V, 2) corners of the targets.
        """
        flags = _tensor(placed)
        token = next_token(flags)
        with torch.inference_mode():
            velocity, _ = self._actor(_tensor(corners), flags, _tensor(goals), token)
        action: Singles = velocity.numpy()
        if self.tokens == 1:
            return action
        selector = (2.0 * token.numpy() + 1.0) / self.tokens - 1.0
        return np.concatenate([selector[:, None].astype(np.float32), action], axis=1)

    def explore(
        self,
        corners: Floats | Singles,
        placed: Flags,
        goals: Floats | Singles,
        generators: Sequence[np.random.Generator],
    ) -> Singles:
        """Actions (B, A) with Gaussian noise, a share of them drawn uniformly.

        Each environment has its own generator, so the noise does not depend on the batching.
        """
        actions = self.act(corners, placed, goals)
        for action, generator in zip(actions, generators, strict=True):
            velocity = action[-3:]
            if generator.random() < self.config.uniform_share:
                velocity[:] = generator.uniform(-1.0, 1.0, 3)
            else:
                velocity += self.config.noise * generator.standard_normal(3)
        return np.clip(actions, -1.0, 1.0)


def _tensor(array: Floats | Singles | Flags) -> torch.Tensor:
    """A copy: arrays that came over the wire are read-only."""
    return torch.from_numpy(np.array(array, np.float32))
