"""Scenes of several tokens on both sides, and what plays them perfectly, for the tests of pairs."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tangram_agent.agents.pair.coverage import Lying, newly_covered
from tangram_agent.agents.pair.pairs import PairGraph, Pairs
from tangram_agent.base.types import Transitions
from tangram_core.arrays import Bools, Floats
from tangram_core.setup import Setup
from tangram_sim.geometry.layout import Layout
from tests.agent.builders import SMALL, setup

SEVEN = {
    "shapes": [
        *("large_triangle", "large_triangle", "medium_triangle"),
        *("small_triangle", "small_triangle", "square", "parallelogram"),
    ],
    "scale": 0.6,
}
TWO = {"shapes": ["square", "parallelogram"], "scale": 0.8}
PERCEPTRON = {"kind": "mlp", "hidden": [16, 16]}


def seven(agent: dict[str, Any] | None = None, net: dict[str, Any] = SMALL, **sim: Any) -> Setup:
    """All tans."""
    return setup(SEVEN, agent, net, **sim)


def random_sides(layout: Layout, rng: np.random.Generator, *shape: int) -> Bools:
    """(..., K) chiral tokens on either side."""
    return np.asarray((rng.random((*shape, layout.tokens)) < 0.5) & layout.chiral)


def random_scene(layout: Layout, rng: np.random.Generator, *shape: int) -> tuple[Floats, Bools]:
    """Poses (..., K, 3) that may overlap, and sides (..., K)."""
    unit = rng.uniform(-1.0, 1.0, (*shape, layout.tokens, 3))
    return unit * (0.6, 0.6, np.pi), random_sides(layout, rng, *shape)


def every_pair(poses: Floats, sides: Bools, goals: Floats, goal_sides: Bools) -> Pairs:
    """All K * K pairs of one scene, token after token, with some share covered of each."""
    count = len(poses)
    token, piece = np.divmod(np.arange(count * count), count)
    return Pairs(
        pose=as_tensor(poses[token]),
        flipped=as_tensor(sides[token]),
        token=torch.from_numpy(token),
        goal=as_tensor(goals[piece]),
        goal_flipped=as_tensor(goal_sides[piece]),
        piece=torch.from_numpy(piece),
        covered=torch.linspace(0.0, 0.9, count * count),
    )


def random_pairs(layout: Layout, seed: int) -> Pairs:
    """All pairs of a random scene."""
    rng = np.random.default_rng(seed)
    return every_pair(*random_scene(layout, rng), *random_scene(layout, rng))


def transitions(made: Setup, count: int, seed: int = 0, placed: float = 0.4) -> Transitions:
    """Transitions between random scenes, tokens on both sides and some of them placed."""
    rng = np.random.default_rng(seed)
    layout = made.task.layout
    corners = layout.corners(*random_scene(layout, rng, count, 3)).astype(np.float32)
    flags = (rng.random((count, layout.tokens)) < placed).astype(np.uint8)
    return Transitions(
        state=corners[:, 0],
        placed=flags,
        action=rng.uniform(-1.0, 1.0, (count, made.task.spec.action_size)).astype(np.float32),
        reward=np.zeros(count, np.float32),
        next_state=corners[:, 1],
        next_placed=flags,
        done=np.zeros(count, np.uint8),
        goal=corners[:, 2],
    )


@dataclass
class PerfectCritic:
    """Knows the exact geometry.

    It may like some tokens less: values count as much as (K,) says.
    """

    layout: Layout
    likes: Floats | None = None

    def __call__(self, before: Pairs, velocity: Tensor, pairs: Pairs) -> Tensor:
        del before, velocity  # as an afterstate critic does
        parts = {
            name: part.detach().numpy().astype(np.float64)
            for name, part in vars(pairs).items()
            if part is not None
        }
        token, piece = parts["token"].astype(np.int64), parts["piece"].astype(np.int64)
        own = Lying(token, parts["pose"], parts["flipped"] > 0.5)
        wanted = Lying(piece, parts["goal"], parts["goal_flipped"] > 0.5)
        value = newly_covered(own, wanted, parts["covered"], self.layout)
        return as_tensor(value if self.likes is None else value * self.likes[token])


@dataclass
class PerfectNetworks:
    """Puts every token exactly onto the piece it is told, and knows what that covers."""

    critic: PerfectCritic

    graph: PairGraph
    motion = None

    def actor(self, pairs: Pairs) -> tuple[Tensor, Tensor]:
        """The way to the piece's own pose."""
        return self.graph.way(pairs, pairs.goal), pairs.goal[:, :2]


def as_tensor(array: Any) -> Tensor:
    """A float tensor."""
    return torch.from_numpy(np.array(array, np.float32))
