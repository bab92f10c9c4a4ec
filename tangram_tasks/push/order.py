"""Which tokens come next, so that no place is shut before its token is in it.

A place is the freer the more directions lead out of it past the tokens that lie already. Convex
shapes can always be laid so that each slides in from one side. The best order leaves the least
free place as free as can be; it is looked for among all of them.

Legend: K tokens, V corners, D directions; a set of tokens is a number with a bit for each.
"""

from functools import lru_cache

import numpy as np

from tangram_core.arrays import AnyArray, Bools, Floats, Ints
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import shared_area
from tangram_tasks.push.places import on_table

DIRECTIONS = 48
MOVED = 0.05, 0.15  # how far a token is moved to see what is in its way
ASIDE = 0.02  # share of a token that may come over another: it is pushed aside a little
ROOMY = 20  # directions that are enough: 150 degrees
COVERED = 0.1  # share of a token on another's place that must go first


def come_next(layout: Layout, corners: AnyArray, goals: AnyArray, placed: Bools) -> Bools:
    """(K,) which tokens may be pushed: the next of a best order, and what lies in their places.

    Args:
        layout: the tokens.
        corners: (V, 2) of the tokens.
        goals: (V, 2) of their places.
        placed: (K,) which are in them.
    """
    there = on_table(goals, layout)
    best, through = _orders(layout, np.asarray(goals, np.float64).tobytes())
    now = int((placed << np.arange(layout.tokens)).sum())
    following = (through[now] >= best[now]) & ~placed & there
    here, places = (at[layout.padded_corners] for at in (corners, goals))
    over = shared_area(*_all_pairs(here, places)).reshape(layout.tokens, -1)
    lies_on = (over > COVERED * layout.areas[:, None]) & ~np.eye(layout.tokens, dtype=np.bool_)
    found: Bools = following | ((lies_on & following).any(axis=1) & ~placed & there)
    return found


@lru_cache(maxsize=1024)
def _orders(layout: Layout, goals: bytes) -> tuple[Ints, Ints]:
    """Of each set that lies, how free the least free place will be: (2**K,), by token (2**K, K).

    -1 for a token that lies, or is not on the table.
    """
    corners, count = np.frombuffer(goals).reshape(-1, 2), layout.tokens
    free, there = _free(layout, corners), on_table(corners, layout)
    best, through = np.full(2**count, ROOMY), np.full((2**count, count), -1)
    for lies in range(2**count - 1, -1, -1):
        held = (lies >> np.arange(count) & 1).astype(np.bool_)
        for token in np.flatnonzero(there & ~held).tolist():
            room = int(free[token, held & there].all(axis=0).sum())
            through[lies, token] = min(room, best[lies | 1 << token])
        if (there & ~held).any():
            best[lies] = through[lies].max()
    return best, through


def _free(layout: Layout, corners: Floats) -> Bools:
    """(K, K, D) in which directions a token gets out of its place past another that lies."""
    outlines = corners[layout.padded_corners]
    ways = np.exp(2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)[:, None] * np.array(MOVED)
    steps = np.stack([ways.real, ways.imag], axis=-1).reshape(-1, 1, 1, 2)
    first, second = _all_pairs((outlines + steps).reshape(-1, *outlines.shape[1:]), outlines)
    over = shared_area(first, second).reshape(DIRECTIONS, len(MOVED), len(outlines), -1)
    free: Bools = np.all(over <= ASIDE * layout.areas[:, None], axis=1)
    return np.moveaxis(free, 0, -1)


def _all_pairs(some: Floats, others: Floats) -> tuple[Floats, Floats]:
    """Each of some polygons (n, C, 2) with each of others (m, C, 2): (n * m, C, 2) of both."""
    return some.repeat(len(others), axis=0), np.tile(others, (len(some), 1, 1))
