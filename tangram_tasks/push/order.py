"""Order of the tokens, so that no place is blocked before its token is in it.

A place is freer, the more directions lead out of it past the tokens that are in place. Convex
shapes can always be laid so that each slides in from one side. The best order, searched among all,
keeps the least free place as free as possible. Once a place is blocked, all orders are equally bad,
and every remaining token may come next.

Legend: K tokens, n of them on the table, V corners, D directions; a set of tokens is a number with
a bit for each.
"""

from functools import lru_cache

import numpy as np

from tangram_core.arrays import AnyArray, Bools, Floats, Ints
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import shared_areas
from tangram_tasks.push.places import on_table

DIRECTIONS = 48
MOVED = 0.05, 0.15  # how far a token of mean radius RADIUS is moved to see what is in its way
RADIUS = 0.22278013147330306  # of the seven tans of tokens=tangram7
ASIDE = 0.02  # share of a token's area that may overlap another, which gives way a little
ROOMY = 20  # free directions that are enough: 150 degrees
MOST = 10  # tokens of which all orders are searched
COVERED = 0.1  # share of a token's area on another's place that makes the token go first


def come_next(layout: Layout, corners: AnyArray, goals: AnyArray, placed: Bools) -> Bools:
    """(K,) which tokens may be pushed: the next ones of a best order, and tokens on their places.

    With more than MOST tokens on the table, every token that is not in place may be pushed, because
    there are too many orders.

    Args:
        layout: the tokens.
        corners: (V, 2) corners of the tokens.
        goals: (V, 2) corners of their places.
        placed: (K,) tokens that are in place.
    """
    there = on_table(goals, layout)
    found, tokens = there & ~placed, np.flatnonzero(there)
    if len(tokens) > MOST or not found.any():
        return found
    best, through = _orders(layout, np.asarray(goals, np.float64).tobytes())
    lies = int((placed[tokens] << np.arange(len(tokens))).sum())
    following = through[lies] >= best[lies]
    here, places = (at[layout.padded_corners[tokens]] for at in (corners, goals))
    over = shared_areas(here[None], places[None])[0]
    lies_on = (over > COVERED * layout.areas[tokens, None]) & ~np.eye(len(tokens), dtype=np.bool_)
    found[tokens] &= following | (lies_on & following).any(axis=1)
    return found


@lru_cache(maxsize=128)
def _orders(layout: Layout, goals: bytes) -> tuple[Ints, Ints]:
    """For each set of tokens in place, directions that the least free place will keep at best.

    By the best order (2**n,), and with each token next (2**n, n), -1 for one that is in place.
    """
    corners = np.frombuffer(goals).reshape(-1, 2)
    tokens = np.flatnonzero(on_table(corners, layout))
    free, count = _free(layout, corners, tokens), len(tokens)
    best, through = np.full(2**count, ROOMY), np.full((2**count, count), -1)
    for lies in range(2**count - 2, -1, -1):
        held = (lies >> np.arange(count) & 1).astype(np.bool_)
        for one in np.flatnonzero(~held).tolist():
            room = int(free[one, held].all(axis=0).sum())
            through[lies, one] = min(room, best[lies | 1 << one])
        best[lies] = through[lies].max()
    return best, through


def _free(layout: Layout, corners: Floats, tokens: Ints) -> Bools:
    """(n, n, D) directions in which one of tokens (n,) can leave its place past another."""
    outlines = corners[layout.padded_corners[tokens]]
    far = np.array(MOVED) * (layout.radii.mean() / RADIUS)
    ways = np.exp(2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)[:, None] * far
    steps = np.stack([ways.real, ways.imag], axis=-1).reshape(-1, 1, 1, 2)
    places = np.broadcast_to(outlines, (len(steps), *outlines.shape))
    over = shared_areas(outlines + steps, places).reshape(DIRECTIONS, len(MOVED), len(tokens), -1)
    free: Bools = np.all(over <= ASIDE * layout.areas[tokens, None], axis=1)
    return np.moveaxis(free, 0, -1)
