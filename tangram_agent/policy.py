"""Acting: a copy of the networks on the CPU, batched, with or without exploration noise.

Legend: B environments, K tokens, V corners, A entries of an action.
"""

from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from tangram_agent.agents.outline.filler import Filler
from tangram_agent.agents.pair.planning import Planner
from tangram_agent.agents.scene.scenes import Scenes, next_token
from tangram_agent.base.weights import load_arrays, to_arrays
from tangram_agent.networks import Networks, outline_network, travels
from tangram_agent.setup import Setup
from tangram_agent.types import Choice, Past, Weights
from tangram_core.arrays import Floats, Singles
from tangram_sim.motion.actions import make_actions

Flags = npt.NDArray[np.bool_] | npt.NDArray[np.uint8]


class Policy:
    """The networks as workers use them.

    Attributes:
        version: of the weights that are loaded; -1 before the first.
        network: what they are of.
    """

    def __init__(self, setup: Setup) -> None:
        self.layout, self.config, self.sim = setup.layout, setup.agent, setup.sim
        self._setup = setup
        self.tokens = setup.layout.tokens
        self.version = -1
        self._planner: Planner | None = None
        self._filler: Filler | None = None
        if setup.fills:
            value = outline_network(setup)
            self.network: nn.Module = value
            self._filler = Filler(value, setup)
        else:
            networks = Networks(setup)
            self.network = networks.playing
            self._planner = Planner(networks, setup) if setup.pairs else None
        self.network.requires_grad_(False)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the tensors that a broadcast brings, see `follow`."""
        every = self.network.named_parameters()
        return {name: tuple(p.shape) for name, p in every if travels(name, self._setup)}

    def follow(self, weights: Weights) -> None:
        """Take over broadcast weights: of those that `load` wants what playing needs.

        Raises:
            RunError: they belong to another layout or network.
        """
        self._load(weights, self.shapes)

    def load(self, weights: Weights) -> None:
        """Take over weights as a checkpoint keeps them.

        Raises:
            RunError: they belong to another layout or network.
        """
        self._load(weights)

    def _load(self, weights: Weights, names: Collection[str] | None = None) -> None:
        load_arrays(self.network, weights.tensors, names)
        self.version = weights.version

    def weights(self) -> Weights:
        """A copy of the weights that are loaded."""
        return Weights(self.version, to_arrays(self.network))

    def act(
        self,
        corners: Floats | Singles,
        placed: Flags,
        goals: Floats | Singles,
        past: Past | None = None,
    ) -> Singles:
        """Actions (B, A) in [-1, 1], noise off.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) which tokens are placed.
            goals: (B, V, 2) corners of the targets, or (B, G, 2) rows of their outlines.
            past: what was seen of these episodes before, if anything: an agent that learns what a
                command comes to corrects itself by it.
        """
        if self._filler is not None:
            return self._filling(self._filler, corners, placed, goals)
        if self._planner is None:
            return self._actions(self._next(corners, placed, goals))
        exact, flags = np.asarray(corners, np.float64), np.asarray(placed, np.bool_)
        wanted = np.asarray(goals, np.float64)
        return self._actions(self._planner.choose(exact, flags, wanted, past))

    def _filling(
        self,
        filler: Filler,
        corners: Floats | Singles,
        placed: Flags,
        outlines: Floats | Singles,
        generators: Sequence[np.random.Generator] = (),
    ) -> Singles:
        """Actions (B, A) on outlines (B, G, 2); with generators a share of them goes anywhere."""
        share = self.config.uniform_share
        drawn = [generator.random() < share for generator in generators]
        anything = np.array(drawn) if drawn else np.zeros(len(corners), np.bool_)
        exact = np.asarray(corners, np.float64), np.asarray(placed, np.bool_)
        wanted = np.asarray(outlines, np.float64)
        return self._actions(filler.choose(*exact, wanted, anything, generators))

    def _actions(self, choice: Choice) -> Singles:
        """Actions (B, A) of what is chosen."""
        return make_actions(choice.token, choice.velocity, choice.flip, self.tokens, self.sim)

    def _next(self, corners: Floats | Singles, placed: Flags, goals: Floats | Singles) -> Choice:
        """The next token in the set's order."""
        flags = _tensor(placed)
        token = next_token(flags)
        with torch.inference_mode():
            scenes = Scenes(_tensor(corners), flags, _tensor(goals), token)
            velocity, _ = self.network(scenes)
        return Choice(token.numpy(), np.zeros(len(token), np.bool_), velocity.numpy())

    def explore(
        self,
        corners: Floats | Singles,
        placed: Flags,
        goals: Floats | Singles,
        generators: Sequence[np.random.Generator],
        past: Past | None = None,
    ) -> Singles:
        """Actions (B, A) with Gaussian noise, a share of them drawn uniformly.

        Each environment has its own generator, so the noise does not depend on the batching.
        """
        if self._filler is not None:
            return self._filling(self._filler, corners, placed, goals, generators)
        actions = self.act(corners, placed, goals, past)
        for i, (action, generator) in enumerate(zip(actions, generators, strict=True)):
            velocity = action[-3:]
            if generator.random() < self.config.uniform_share:
                if self._planner is None:
                    velocity[:] = generator.uniform(-1.0, 1.0, 3)
                else:
                    here = self.layout.poses(np.asarray(corners[i], np.float64))
                    open_to = np.asarray(placed)[i]
                    action[:] = self._anything(self._planner, here, open_to, generator)
            else:
                velocity += self.config.noise * generator.standard_normal(3)
        return np.clip(actions, -1.0, 1.0)

    def _anything(
        self, planner: Planner, here: Floats, placed: Flags, generator: np.random.Generator
    ) -> Singles:
        """An action (A,): any token that is left goes to any pose in the arena, on any side.

        Args:
            planner: knows the way there.
            here: (K, 3) poses of the tokens.
            placed: (K,) which are placed; where all are, the first one is named.
            generator: draws it.
        """
        left = np.flatnonzero(np.asarray(placed) == 0)
        token = int(generator.choice(left)) if len(left) else 0
        reach = (self.sim.arena / 2.0, self.sim.arena / 2.0, np.pi)
        wanted = generator.uniform(-1.0, 1.0, 3) * reach
        flip = self.sim.allow_flip and generator.choice((-1.0, 1.0)) > 0.0
        velocity = planner.velocity_to(here[None, token], wanted[None])
        action: Singles = self._actions(Choice(np.array([token]), np.array([flip]), velocity))[0]
        return action


def _tensor(array: Floats | Singles | Flags) -> torch.Tensor:
    """A copy: arrays that came over the wire are read-only."""
    return torch.from_numpy(np.array(array, np.float32))
