"""Random targets of connected pieces: each shares a part of an edge with an earlier piece.

Points and directions are complex numbers here. Legend: n candidates, k pieces laid before, C
corners (and edges) of a piece, padded to those of the largest by repeating the last one.
"""

from dataclasses import dataclass

import numpy as np

from tangram_core.arrays import Bools, Complex, Floats, Ints
from tangram_core.errors import SamplingError
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.kinematics import wrap
from tangram_sim.targets.sampling import MAX_TRIES, check_fits

_CHUNK = 16  # candidates checked together
_ALIGNED = 0.7  # share of pieces laid with a corner at a corner of the other piece
_TOUCHING = 1e-9  # depth of an overlap that counts as rounding, as a share of the arena
MAX_PILE = 3  # touching tokens that can be found in a picture; for more the search is too slow


def sample_connected(layout: Layout, sim: SimConfig, rng: np.random.Generator) -> Floats:
    """Random poses (K, 3) of pieces that are connected edge to edge; none is turned over.

    The pieces come in random order. Each is laid with a random edge along a random edge of a
    random earlier piece, mostly corner to corner. The whole gets a random rotation and shift.

    Raises:
        SamplingError: a token does not fit into the arena, or `MAX_TRIES` tries found no place
            for it.
    """
    check_fits(layout, sim)
    order = rng.permutation(layout.tokens)
    return _laid_out(layout, _chained(layout, order, sim, rng), sim, rng)


def _chained(layout: Layout, order: Ints, sim: SimConfig, rng: np.random.Generator) -> Floats:
    """Poses (K, 3) in which each token of an order (K,) touches an earlier one."""
    bodies = _bodies(layout)
    turns, shifts = np.ones(layout.tokens, np.complex128), np.zeros(layout.tokens, np.complex128)
    for number, token in enumerate(order[1:], 1):
        before = order[:number]
        laid = bodies.of(before).moved(turns[before, None], shifts[before, None])
        turns[token], shifts[token] = _attached(bodies.of(token), laid, sim, rng)
    return np.column_stack([shifts.real, shifts.imag, np.angle(turns)])


@dataclass(frozen=True, eq=False)
class _Outlines:
    """Outlines of pieces as complex numbers x + iy.

    Attributes:
        corners: (..., C), counter-clockwise.
        edges: (..., C) unit vectors along the edge after each corner.
        lengths: (..., C) of the edges.
        count: (...,) number of corners without padding.
    """

    corners: Complex
    edges: Complex
    lengths: Floats
    count: Ints

    def of(self, which: Ints) -> "_Outlines":
        """The outlines of the tokens `which`."""
        return _Outlines(
            self.corners[which], self.edges[which], self.lengths[which], self.count[which]
        )

    def moved(self, turn: Complex, shift: Complex) -> "_Outlines":
        """The outlines rotated by a complex number of length 1, then shifted."""
        corners = self.corners * turn + shift
        return _Outlines(corners, self.edges * turn, self.lengths, self.count)


def _bodies(layout: Layout) -> _Outlines:
    corners: Complex = layout.body[:, 0] + 1j * layout.body[:, 1]
    ahead = np.concatenate(
        [np.roll(corners[layout.corners_of(k)], -1) for k in range(layout.tokens)]
    )
    edges, own = (ahead - corners)[layout.padded_corners], corners[layout.padded_corners]
    lengths: Floats = np.abs(edges)
    units = (edges / lengths).astype(np.complex128)
    return _Outlines(own, units, lengths, np.diff(layout.starts))


def _attached(
    piece: _Outlines, laid: _Outlines, sim: SimConfig, rng: np.random.Generator
) -> tuple[complex, complex]:
    """Rotation and shift of a piece that touches one of the others and overlaps none."""
    for _ in range(-(-MAX_TRIES // _CHUNK)):
        turn, shift = _candidates(piece, laid, rng)
        moved = piece.moved(turn[:, None], shift[:, None])
        extent = np.abs(moved.corners[:, :, None] - laid.corners.ravel()).max(axis=(1, 2))
        free = _apart(moved, laid, _TOUCHING * sim.arena) & (extent < sim.arena)
        if free.any():
            first = int(np.argmax(free))
            return complex(turn[first]), complex(shift[first])
    raise SamplingError(
        f"no connected target within an arena of width {sim.arena:g} in {MAX_TRIES} tries: "
        "raise sim.arena, or lower tokens.scale"
    )


def _candidates(
    piece: _Outlines, laid: _Outlines, rng: np.random.Generator
) -> tuple[Complex, Complex]:
    """Rotations and shifts (n,) that lay a random edge along a random edge of the others."""
    drawn = rng.random((_CHUNK, 4))
    other = (drawn[:, 0] * len(laid.corners)).astype(np.int64)
    i = (drawn[:, 1] * laid.count[other]).astype(np.int64)
    j = (drawn[:, 2] * piece.count).astype(np.int64)
    along, length, own = laid.edges[other, i], laid.lengths[other, i], piece.lengths[j]
    # Distance from the start of the other's edge to the end of the piece's edge, along the edge.
    free = (drawn[:, 3] - _ALIGNED) / (1.0 - _ALIGNED)
    anywhere = -0.8 * own + free * (length + 0.6 * own)
    aligned = np.where(drawn[:, 3] < _ALIGNED / 2.0, 0.0, length - own)
    ends = laid.corners[other, i] + along * np.where(free < 0.0, aligned, anywhere)
    turn: Complex = -along / piece.edges[j]
    return turn, ends - (piece.corners[j] + own * piece.edges[j]) * turn


def _apart(pieces: _Outlines, laid: _Outlines, depth: float) -> Bools:
    """(n,) whether a piece overlaps none of the others by more than a depth.

    Two convex pieces are apart if all of one lies outside an edge of the other.
    """
    outside = _outside(pieces, laid, depth) | _outside(laid, pieces, depth).T
    return np.asarray(outside.all(axis=1))


def _outside(pieces: _Outlines, others: _Outlines, depth: float) -> Bools:
    """(n, k) whether all of the other piece lies outside some edge of a piece."""
    gap = others.corners[None, :, None] - pieces.corners[:, None, :, None]
    inwards = (pieces.edges.conj()[:, None, :, None] * gap).imag
    return np.asarray((inwards <= depth).all(axis=-1).any(axis=-1))


def _laid_out(layout: Layout, poses: Floats, sim: SimConfig, rng: np.random.Generator) -> Floats:
    """The whole at a random angle, and at a random place with all tokens in the arena."""
    turn = rng.uniform(-np.pi, np.pi)
    centres = (poses[:, :2] @ (1.0, 1j)) * np.exp(1j * turn)
    turned = np.column_stack([centres.real, centres.imag, poses[:, 2] + turn])
    corners = layout.corners(turned)
    low, high = corners.min(axis=0), corners.max(axis=0)
    room = sim.arena - (high - low)
    turned[:, :2] += room * rng.random(2) - sim.arena / 2.0 - low
    turned[:, 2] = wrap(turned[:, 2])
    return turned
