"""Which token goes onto which piece of the target: equal ones may change places.

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
    """The target piece of each token, and the way to it.

    Attributes:
        target: (E, K) number of the piece.
        way: (E, K, 3) x, y (arena units) and the smallest turn (radians) from the token to it.
        other_side: (E, K) the piece lies on the other side than the token.
    """

    target: Ints
    way: Floats
    other_side: Bools


def paired(layout: Layout, corners: Floats, goals: Floats) -> Pairing:
    """Pair the tokens with pieces of their shape so that they have the least way in all.

    A way is the distance of the centres and the arc of the farthest corner; a token whose side is
    not the piece's takes it only where no other can.

    Args:
        layout: the tokens.
        corners: (E, V, 2) of the tokens.
        goals: (E, V, 2) of the target.
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
    """Columns (n,) of rows 0 to n - 1 of a cost (n, n): those of the least sum."""
    # Only here: its import takes half a second of CPU time, and one token needs none of it.
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415

    return np.asarray(linear_sum_assignment(cost)[1])


def alike(layout: Layout) -> Bools:
    """(K, K) which tokens have one shape and size, and are on one side the same when turned."""
    same: Bools = np.isfinite(_turns(layout))
    return same


@lru_cache(maxsize=16)
def _turns(layout: Layout) -> Floats:
    """(K, K) the turn of a token's body that gives another's, NaN where none does."""
    turns = np.full((layout.tokens, layout.tokens), np.nan)
    for k, own in enumerate(layout.shapes):
        for j, other in enumerate(layout.shapes):
            turn = 0.0 if k == j else turn_onto(own.corners, other.corners)
            turns[k, j] = np.nan if turn is None else turn
    return turns


def _groups(turns: Floats) -> list[Ints]:
    """The tokens of each shape that several have."""
    groups = [np.flatnonzero(row) for k, row in enumerate(np.isfinite(turns)) if row.argmax() == k]
    return [group for group in groups if len(group) > 1]


def all_ways(layout: Layout, corners: Floats, goals: Floats) -> Floats:
    """(E, K, K, 3) from every token to every piece, the turn modulo the symmetry."""
    turns = _turns(layout)
    ways: Floats = layout.poses(goals)[:, None] - layout.poses(corners)[:, :, None]
    # A body on its other side is turned the other way.
    turn = np.where(layout.flipped(goals)[:, None], -1.0, 1.0) * np.nan_to_num(turns)
    period = 2.0 * np.pi / layout.symmetries
    ways[..., 2] += turn
    ways[..., 2] -= period * np.round(ways[..., 2] / period)
    return ways
