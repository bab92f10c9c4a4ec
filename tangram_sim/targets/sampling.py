"""Random layouts without overlap, drawn token by token.

The largest token comes first. Each pose is uniform over those that the earlier tokens leave free.
Rejecting whole layouts with an overlap would be uniform over layouts. But it hardly ever succeeds
for seven tokens that fill a tenth of the arena.

Each environment draws from its own generator only. So its layout does not depend on the others of
the batch, which are checked together for speed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints
from tangram_core.errors import SamplingError
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines_at, pairs_overlap

MAX_TRIES = 1000  # random poses tried for one token before sampling gives up
_CHUNK = 4  # poses drawn at once when some may overlap, for fewer and larger checks
_TOUCHING = 1e-9  # an overlap that counts as rounding, in squares of the reach
_CLEAR_TRIES = 64  # tries to keep clear of `avoid`; then it is ignored

Generators = Sequence[np.random.Generator]


def sample_batch(
    layout: Layout,
    sim: SimConfig,
    generators: Generators,
    flipped: Bools | None = None,
    avoid: Floats | None = None,
) -> Floats:
    """One random layout per generator: poses (B, K, 3), angles in (-pi, pi].

    Angles are uniform, and no two tokens of a layout overlap. A token's centre lies where the token
    is inside the arena at every angle, or, with `sim.overhang`, anywhere in the arena.

    Args:
        layout: the tokens.
        sim: settings of the world, for the arena.
        generators: one for each of B environments.
        flipped: (B, K) tokens that are turned over; None: no token is.
        avoid: (B, M, C, 2) outlines that tokens keep clear of where there is room.

    Raises:
        SamplingError: a token does not fit into the arena, or all `MAX_TRIES` poses of a token
            overlapped earlier tokens.
    """
    reach = check_fits(layout, sim)
    poses = np.empty((len(generators), layout.tokens, 3))
    sides = np.zeros(poses.shape[:2], np.bool_) if flipped is None else flipped
    order = np.argsort(-layout.areas, kind="stable").tolist()
    bodies = layout.body[layout.padded_corners]
    placed: Floats = np.empty((len(generators), 0, *bodies.shape[1:]))
    for token in order:
        piece = _Piece(layout.shapes[token].name, bodies[token], reach[token], sides[:, token])
        if not _place(piece, placed, avoid, generators, poses[:, token]):
            raise SamplingError(
                f"no room for token '{piece.name}' beside {placed.shape[1]} others in {MAX_TRIES} "
                f"tries in an arena of width {sim.arena:g}: raise sim.arena, or lower tokens.scale"
            )
        outline = outlines_at(piece.body, poses[:, token], sides[:, token])
        placed = np.concatenate([placed, outline[:, None]], axis=1)
    return poses


@dataclass(frozen=True, eq=False)
class _Piece:
    """A token to be placed.

    Attributes:
        name: of its shape.
        body: (C, 2) corners.
        reach: largest |coordinate| of its centre.
        flipped: (B,) whether it is turned over.
    """

    name: str
    body: Floats
    reach: float
    flipped: Bools


def _place(
    piece: _Piece, placed: Floats, avoid: Floats | None, generators: Generators, poses: Floats
) -> bool:
    """Fill the poses (B, 3) of a token, clear of placed ones (B, k, C, 2); return success."""
    open_rows = np.arange(len(poses))
    if avoid is not None:
        both = np.concatenate([placed, avoid], axis=1)
        open_rows = _try(piece, both, generators, poses, open_rows, _CLEAR_TRIES)
    return not len(_try(piece, placed, generators, poses, open_rows, MAX_TRIES))


def _try(
    piece: _Piece,
    obstacles: Floats,
    generators: Generators,
    poses: Floats,
    open_rows: Ints,
    limit: int,
) -> Ints:
    """Fill open rows of poses (B, 3) in at most `limit` tries each; return rows still open."""
    chunk = _CHUNK if obstacles.shape[1] else 1
    tries = 0
    while len(open_rows) and tries < limit:
        size = min(chunk, limit - tries)
        unit = np.stack([1.0 - 2.0 * generators[b].random((size, 3)) for b in open_rows.tolist()])
        drawn = unit * np.array([piece.reach, piece.reach, np.pi])  # angles in (-pi, pi]
        blocked = _blocked(piece, drawn, obstacles[open_rows], piece.flipped[open_rows])
        first = np.argmin(blocked, axis=1)
        free = ~blocked[np.arange(len(open_rows)), first]
        poses[open_rows[free]] = drawn[free, first[free]]
        open_rows = open_rows[~free]
        tries += size
    return open_rows


def _blocked(piece: _Piece, drawn: Floats, obstacles: Floats, flipped: Bools) -> Bools:
    """(B, size) which of the poses (B, size, 3) overlap an obstacle (B, k, C, 2)."""
    rows, size, before = *drawn.shape[:2], obstacles.shape[1]
    if not before:
        return np.zeros((rows, size), dtype=np.bool_)
    drawn_outlines = outlines_at(piece.body, drawn.reshape(-1, 3), np.repeat(flipped, size))
    own = np.repeat(drawn_outlines, before, axis=0)
    others = np.repeat(obstacles, size, axis=0).reshape(len(own), -1, 2)
    overlap = pairs_overlap(own, others, _TOUCHING * piece.reach**2)
    return np.asarray(overlap.reshape(rows, size, before).any(axis=2))


def check_fits(layout: Layout, sim: SimConfig) -> Floats:
    """(K,) largest |coordinate| of each token's centre; SamplingError if it does not fit."""
    reach: Floats = sim.arena / 2.0 - layout.radii
    if (reach < 0.0).any():
        worst = layout.shapes[int(np.argmin(reach))]
        raise SamplingError(
            f"token '{worst.name}' with radius {worst.radius:.3g} does not fit into an arena of "
            f"width {sim.arena:g} at every angle: raise sim.arena to at least "
            f"{2.0 * worst.radius:.3g}, or lower tokens.scale"
        )
    return np.full(layout.tokens, sim.arena / 2.0) if sim.overhang else reach
