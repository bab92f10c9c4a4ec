"""Assignment of tokens to pieces of the target: equal tokens may change places.

Legend: E episodes, K tokens, V corners.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.shapes import turn_onto


@dataclass(frozen=True, eq=False)
class Pairing:
    """The target piece of each token, and the way from token to piece.

    Attributes:
        target: (E, K) number of the piece.
        way: (E, K, 3) x, y (arena units) and smallest turn (radians) from token to piece.
        other_side: (E, K) whether the token must be turned over to match the piece.
    """

    target: Ints
    way: Floats
    other_side: Bools


def paired(layout: Layout, corners: Floats, goals: Floats) -> Pairing:
    """Pair each token with a piece of its shape so that the sum of all ways is least.

    The length of a way is the distance of the centres plus the arc of the farthest corner. A token
    gets a piece that lies on its other side only if no other pairing is left.

    Args:
        layout: the tokens.
        corners: (E, V, 2) corners of the tokens.
        goals: (E, V, 2) corners of the target.
    """
    turns = _turns(layout)
    ways = all_ways(layout, corners, goals)
    sides = layout.flipped(corners)[:, :, None] != layout.flipped(goals)[:, None, :]
    cost = np.linalg.norm(ways[..., :2], axis=-1) + layout.radii[:, None] * np.abs(ways[..., 2])
    cost += sides * (cost.sum(axis=(1, 2), keepdims=True) + 1.0)
    target = np.tile(np.arange(layout.tokens), (len(corners), 1))
    for group in _groups(turns):
        if len(group) > 1:
            for e in range(len(corners)):
                target[e, group] = group[_assigned(cost[e][np.ix_(group, group)])]
    rows, tokens = np.arange(len(corners))[:, None], np.arange(layout.tokens)
    return Pairing(target, ways[rows, tokens, target], sides[rows, tokens, target])


def _assigned(cost: Floats) -> Ints:
    """The column of each row of a cost matrix (n, n), so that the sum is least."""
    # Imported here: scipy takes half a second of CPU time, and a single token does not need it.
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415

    return np.asarray(linear_sum_assignment(cost)[1])


def alike(layout: Layout) -> Bools:
    """(K, K) whether a turn, without a flip, makes one token's shape equal another's."""
    same: Bools = np.isfinite(_turns(layout))
    return same


@lru_cache(maxsize=16)
def _turns(layout: Layout) -> Floats:
    """(K, K) turn in radians that maps one token's body onto another's; NaN if none does."""
    turns = np.full((layout.tokens, layout.tokens), np.nan)
    for k, own in enumerate(layout.shapes):
        for j, other in enumerate(layout.shapes):
            turn = 0.0 if k == j else turn_onto(own.corners, other.corners)
            turns[k, j] = np.nan if turn is None else turn
    return turns


def _groups(turns: Floats) -> list[Ints]:
    """Numbers of the tokens of each shape that several tokens have."""
    groups = [np.flatnonzero(row) for k, row in enumerate(np.isfinite(turns)) if row.argmax() == k]
    return [group for group in groups if len(group) > 1]


def all_ways(layout: Layout, corners: Floats, goals: Floats) -> Floats:
    """(E, K, K, 3) x, y and turn (modulo the symmetry) from every token to every piece."""
    turns = _turns(layout)
    ways: Floats = layout.poses(goals)[:, None] - layout.poses(corners)[:, :, None]
    # A flipped body turns in the opposite direction.
    turn = np.where(layout.flipped(goals)[:, None], -1.0, 1.0) * np.nan_to_num(turns)
    period = 2.0 * np.pi / layout.symmetries
    ways[..., 2] += turn
    ways[..., 2] -= period * np.round(ways[..., 2] / period)
    return ways
