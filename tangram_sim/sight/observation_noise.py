"""What an agent sees of the corners: exact ones, or ones with the noise of a corner detector."""

from collections.abc import Sequence

import numpy as np

from tangram_core.arrays import Floats
from tangram_sim.config import SimConfig

# Noise is cut here, in standard deviations, so that coordinates have a bound.
CUT = 4.0


def noise_bound(sim: SimConfig) -> float:
    """The most that noise can move a coordinate, arena units."""
    return CUT * sim.corner_noise * sim.arena


def see(corners: Floats, sim: SimConfig, generators: Sequence[np.random.Generator]) -> Floats:
    """Corners (B, V, 2), arena units, with independent Gaussian noise on every coordinate.

    Without noise these are the corners themselves, and nothing is drawn.
    """
    if sim.corner_noise == 0.0:
        return corners
    drawn = np.stack([generator.standard_normal(corners.shape[1:]) for generator in generators])
    seen: Floats = corners + np.clip(drawn, -CUT, CUT) * sim.corner_noise * sim.arena
    return seen
