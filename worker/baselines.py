"""Three policies to compare with: chance, the paper's plateau, and a perfect hand.

Legend: B environments, K tokens, V corners, A entries of an action.
"""

import numpy as np

from tangram_sim.arrays import Bools, Floats, Singles
from tangram_sim.layout import Layout
from worker.rollout import Choose, Generators


def random_policy(action_size: int) -> Choose:
    """Every entry uniform in [-1, 1]; with several tokens most of its choices are refused."""

    def choose(_corners: Floats, _placed: Bools, _goals: Floats, generators: Generators) -> Singles:
        drawn = [generator.uniform(-1.0, 1.0, action_size) for generator in generators]
        return np.array(drawn, np.float32)

    return choose


def position_policy(layout: Layout, arena: float) -> Choose:
    """Token after token exactly onto the centre of its own target, and never turned.

    A square moved so overlaps by 0.8825 on average: that is the plateau of the paper's Table II.
    """

    def choose(corners: Floats, placed: Bools, goals: Floats, _generators: Generators) -> Singles:
        way = _ways(layout, corners, goals)
        way[..., 2] = 0.0
        return _actions(way, placed, arena)

    return choose


def exact_policy(layout: Layout, arena: float) -> Choose:
    """Token after token exactly onto its own target as it is seen, by the smallest turn that fits.

    What remains to a perfect score is the world's: float32 actions, and the engine's arithmetic.
    """
    period = 2.0 * np.pi / np.array([shape.symmetry for shape in layout.shapes])

    def choose(corners: Floats, placed: Bools, goals: Floats, _generators: Generators) -> Singles:
        way = _ways(layout, corners, goals)
        way[..., 2] -= period * np.round(way[..., 2] / period)
        return _actions(way, placed, arena)

    return choose


def _ways(layout: Layout, corners: Floats, goals: Floats) -> Floats:
    """(B, K, 3) from every token's pose to its target's."""
    ways: Floats = layout.poses(goals) - layout.poses(corners)
    return ways


def _actions(ways: Floats, placed: Bools, arena: float) -> Singles:
    """Actions (B, A) that take the first token that is not placed along its way (B, K, 3)."""
    token = np.argmin(placed, axis=1)
    motion = ways[np.arange(len(ways)), token] / np.array([arena, arena, np.pi])
    tokens = ways.shape[1]
    if tokens > 1:
        selector = (2.0 * token + 1.0) / tokens - 1.0
        motion = np.column_stack([selector, motion])
    actions: Singles = motion.astype(np.float32)
    return actions
