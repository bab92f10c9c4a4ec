"""The actor of actor-critic agents, which plays a policy in workers.

Legend: B environments, F entries of a row, A entries of an action.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.flat.inputs import Inputs, normalised
from tangram_agent.flat.networks import Policy
from tangram_agent.nets.weights import load_arrays, under
from tangram_core.agent import Actor
from tangram_core.arrays import Singles
from tangram_core.errors import RunError
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History

MEAN, SCALE, POLICY = "mean", "scale", "policy."


class Decision(nn.Module):
    """Network from the task's fields, by name, to actions (B, A) without exploration."""

    mean: Tensor
    scale: Tensor

    def __init__(self, policy: Policy, names: Sequence[str], mean: Singles, scale: Singles) -> None:
        super().__init__()
        self.policy, self._names = policy, names
        self.register_buffer("mean", torch.from_numpy(mean), persistent=False)
        self.register_buffer("scale", torch.from_numpy(scale), persistent=False)

    def forward(self, seen: Mapping[str, Tensor]) -> Tensor:
        """Actions (B, A) for fields (B, ...)."""
        rows = torch.cat([seen[name].flatten(1) for name in self._names], dim=1)
        actions: Tensor = self.policy(normalised(rows, self.mean, self.scale))
        return actions


class PolicyActor(Actor):
    """Plays a policy whose inputs are normalised by running statistics."""

    def __init__(self, policy: Policy, inputs: Inputs, uniform_share: float) -> None:
        self._policy, self._inputs = policy.requires_grad_(False), inputs
        self._uniform = uniform_share
        self._mean = np.zeros(inputs.size, np.float32)
        self._scale = np.ones(inputs.size, np.float32)

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shapes of the statistics and of the policy's parameters, by name."""
        size = (self._inputs.size,)
        own = self._policy.named_parameters()
        return {MEAN: size, SCALE: size} | {POLICY + name: tuple(p.shape) for name, p in own}

    def load(self, weights: Mapping[str, Singles]) -> None:
        """Load the weights of `ActorCritic.broadcast`."""
        for name in (MEAN, SCALE):
            if name not in weights or weights[name].shape != self.shapes[name]:
                raise RunError(
                    f"weights of another task: '{name}' must be {self.shapes[name]}: play the task "
                    "that they were trained with"
                )
        if not (np.isfinite(weights[MEAN]).all() and (weights[SCALE] > 0).all()):
            raise RunError("damaged weights: the statistics must be finite, with positive scales")
        load_arrays(self._policy, under(POLICY, dict(weights)))
        self._mean, self._scale = np.array(weights[MEAN]), np.array(weights[SCALE])

    def graph(self) -> "Decision":
        """The normalisation and the policy, as one network."""
        return Decision(self._policy, self._inputs.names, self._mean, self._scale)

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:  # noqa: ARG002
        """Actions (B, A); while exploring, with noise and a share of them uniform."""
        rows = torch.from_numpy(normalised(self._inputs.rows(seen), self._mean, self._scale))
        with torch.no_grad():
            if explore is None:
                return np.asarray(self._policy(rows).numpy(), np.float32)
            size = self._policy.actions
            # All numbers are always drawn, so that later ones do not depend on the choice below.
            drawn = [
                (one.random(), one.uniform(-1, 1, size), one.standard_normal(size))
                for one in explore
            ]
            chance, uniform, normals = (
                np.array(part, np.float32) for part in zip(*drawn, strict=True)
            )
            actions = self._policy.explore(rows, torch.from_numpy(normals)).numpy()
        return np.where(chance[:, None] < self._uniform, uniform, actions).astype(np.float32)
