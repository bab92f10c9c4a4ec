"""Small worlds for the tests of tangram_sim."""

from typing import Any

import numpy as np
import shapely

from tangram_core.arrays import Floats
from tangram_core.seeding import episode_generator
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tangram_sim.targets.sampling import sample_batch

SQUARE_SCALE = 0.8 * 2.0**0.5  # the square's side is then 0.4
SEVEN = (
    "large_triangle",
    "large_triangle",
    "medium_triangle",
    "small_triangle",
    "small_triangle",
    "square",
    "parallelogram",
)
TRIO = ("square", "small_triangle", "parallelogram")
# Its centre of area is not the mean of its corners.
LOPSIDED = {"name": "lopsided", "corners": [[0, 0], [4, 0], [3, 1], [0, 2]]}


def evaluation_generators(count: int) -> list[np.random.Generator]:
    """Those of the fixed test set: one for each test, the same in every run."""
    return [episode_generator(0, "evaluation", 0, 0, i) for i in range(count)]


def layout_of(*shapes: Any, scale: float = SQUARE_SCALE) -> Layout:
    return make_layout(TokensConfig(shapes, scale))


def sample_poses(layout: Layout, sim: SimConfig, rng: np.random.Generator) -> Floats:
    """(K, 3) of tokens that lie apart."""
    poses: Floats = sample_batch(layout, sim, [rng])[0]
    return poses


def random_poses(rng: np.random.Generator, size: int, tokens: int, spread: float) -> Floats:
    """(size, K, 3), positions uniform within +-spread, any angle; tokens may overlap."""
    unit = rng.uniform(-1.0, 1.0, (size, tokens, 3))
    return unit * np.array([spread, spread, np.pi])


def polygons(layout: Layout, corners: Floats) -> list[shapely.Polygon]:
    """The tokens with corners (V, 2)."""
    return [shapely.Polygon(corners[layout.corners_of(k)]) for k in range(layout.tokens)]


def pieces(layout: Layout, poses: Floats, flipped: Any = None) -> list[shapely.Polygon]:
    """The tokens of one layout (K, 3)."""
    return polygons(layout, layout.corners(poses, flipped))


def largest_overlap(layout: Layout, poses: Floats, flipped: Any = None) -> float:
    """The largest area that two tokens of one layout (K, 3) share.

    On a grid: without one GEOS 3.14 takes some pieces that only share an edge for one and the same.
    """
    own = pieces(layout, poses, flipped)
    both = [shapely.intersection(a, b, grid_size=1e-12) for i, a in enumerate(own) for b in own[:i]]
    return max((shared.area for shared in both), default=0.0)


def angle_gap(first: Floats, second: Floats) -> Floats:
    """Absolute difference of angles in radians, in [0, pi]."""
    gap: Floats = np.abs(np.angle(np.exp(1j * (np.asarray(first) - np.asarray(second)))))
    return gap
