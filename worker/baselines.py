"""Two policies to compare with: chance, and the paper's plateau.

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
        token = np.argmin(placed, axis=1)
        row = np.arange(len(corners))
        shift = (layout.bases(goals) - layout.bases(corners))[row, token] / arena
        motion = np.column_stack([shift, np.zeros(len(shift))])
        if layout.tokens == 1:
            return motion.astype(np.float32)
        selector = (2.0 * token + 1.0) / layout.tokens - 1.0
        return np.column_stack([selector, motion]).astype(np.float32)

    return choose
