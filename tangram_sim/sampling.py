"""Targets and starts: uniform positions and orientations without overlap (Sec. V).

Tokens are placed one after the other, the largest first, each uniform over the poses that those
before it leave free. Drawing whole layouts and rejecting those with an overlap would be uniform
over layouts, but hardly ever succeeds for seven tokens that fill a sixth of the arena.

Each environment draws from its own generator only: what it gets does not depend on the others of
the batch, which are only checked together for speed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tangram_sim.arrays import Bools, Floats
from tangram_sim.config import SimConfig
from tangram_sim.errors import SamplingError
from tangram_sim.geometry import pairs_overlap
from tangram_sim.layout import Layout

_CHUNK = 4  # poses drawn at once when some may overlap: fewer, larger checks


def sample_poses(layout: Layout, sim: SimConfig, rng: np.random.Generator) -> Floats:
    """One layout (K, 3): x, y and angle; see `sample_batch`."""
    poses: Floats = sample_batch(layout, sim, [rng])[0]
    return poses


def sample_batch(
    layout: Layout, sim: SimConfig, generators: Sequence[np.random.Generator]
) -> Floats:
    """One layout per generator: (B, K, 3) of x, y (arena units) and angle in (-pi, pi].

    Centres are uniform in the square that keeps the token inside the arena at every angle, angles
    are uniform, and no two tokens of a layout overlap.

    Raises:
        SamplingError: a token does not fit into the arena, or `sim.max_tries` poses for one all
            overlapped those before it.
    """
    reach = check_fits(layout, sim)
    poses = np.empty((len(generators), layout.tokens, 3))
    order = sorted(range(layout.tokens), key=lambda token: -layout.shapes[token].area)
    bodies = layout.body[layout.padded_corners]
    obstacles: Floats = np.empty((len(generators), 0, *bodies.shape[1:]))
    for token in order:
        piece = _Piece(layout.shapes[token].name, bodies[token], reach[token])
        poses[:, token] = _place(piece, obstacles, sim, generators)
        placed = piece.outlines(poses[:, token])
        obstacles = np.concatenate([obstacles, placed[:, None]], axis=1)
    return poses


@dataclass(frozen=True, eq=False)
class _Piece:
    """A token that is to be placed: its name, corners (C, 2) and how far out its centre may be."""

    name: str
    body: Floats
    reach: float

    def outlines(self, poses: Floats) -> Floats:
        """Corners (M, C, 2) in poses (M, 3)."""
        cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x, y = self.body.T
        turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
        moved: Floats = turned + poses[:, None, :2]
        return moved


def _place(
    piece: _Piece,
    obstacles: Floats,
    sim: SimConfig,
    generators: Sequence[np.random.Generator],
) -> Floats:
    """(B, 3) a pose of one token in every environment, clear of all obstacles (B, k, C, 2)."""
    poses = np.empty((len(generators), 3))
    before = obstacles.shape[1]
    chunk = _CHUNK if before else 1
    open_rows = np.arange(len(generators))
    tries = 0
    while len(open_rows):
        size = min(chunk, sim.max_tries - tries)
        if size == 0:
            raise _exhausted(piece.name, before, sim)
        drawn = np.stack([_draw(generators[b], size, piece.reach) for b in open_rows.tolist()])
        blocked = _blocked(piece, drawn, obstacles[open_rows])
        first = np.argmin(blocked, axis=1)
        free = ~blocked[np.arange(len(open_rows)), first]
        poses[open_rows[free]] = drawn[free, first[free]]
        open_rows = open_rows[~free]
        tries += size
    return poses


def _draw(rng: np.random.Generator, size: int, reach: float) -> Floats:
    """(size, 3) poses, overlapping or not."""
    unit: Floats = 1.0 - 2.0 * rng.random((size, 3))  # in (-1, 1]
    poses: Floats = unit * np.array([reach, reach, np.pi])
    return poses


def _blocked(piece: _Piece, drawn: Floats, obstacles: Floats) -> Bools:
    """(B, size), which of the poses (B, size, 3) overlap an obstacle (B, k, C, 2)."""
    rows, size, before = *drawn.shape[:2], obstacles.shape[1]
    if not before:
        return np.zeros((rows, size), dtype=np.bool_)
    own = np.repeat(piece.outlines(drawn.reshape(-1, 3)), before, axis=0)
    others = np.repeat(obstacles, size, axis=0).reshape(len(own), -1, 2)
    return np.asarray(pairs_overlap(own, others).reshape(rows, size, before).any(axis=2))


def check_fits(layout: Layout, sim: SimConfig) -> Floats:
    """(K,) largest coordinate of each token's centre.

    Raises:
        SamplingError: a token does not fit into the arena at every angle.
    """
    radius = np.array([shape.radius for shape in layout.shapes])
    reach: Floats = sim.arena / 2.0 - radius
    if (reach < 0.0).any():
        worst = layout.shapes[int(np.argmin(reach))]
        raise SamplingError(
            f"token '{worst.name}' with radius {worst.radius:.3g} does not fit into an arena of "
            f"width {sim.arena:g} at every angle: raise sim.arena to at least "
            f"{2.0 * worst.radius:.3g}, or lower tokens.scale"
        )
    return reach


def _exhausted(name: str, before: int, sim: SimConfig) -> SamplingError:
    return SamplingError(
        f"no room for token '{name}' beside {before} others in {sim.max_tries} tries in an "
        f"arena of width {sim.arena:g}: raise sim.arena or sim.max_tries, or lower tokens.scale"
    )
