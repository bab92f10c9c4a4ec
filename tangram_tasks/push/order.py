"""In which order tokens can be brought to their places, so that none is shut out.

A place is the freer the more directions lead out of it past what lies already. Convex shapes can
always be laid so that each slides in from one side, so there is an order; the best one leaves the
least free place as free as can be.

Legend: K tokens, V corners, D directions; a set of tokens is a number with a bit for each.
"""

from functools import lru_cache

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints
from tangram_core.spec import Array
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import shared_area
from tangram_tasks.push.places import on_table

DIRECTIONS = 48
AWAY = 0.05, 0.15  # how far a token is moved to see what is in its way
OVER = 0.02  # share of a token that may come over another: it is pushed aside a little
ROOMY = 20  # directions that are enough: 150 degrees


def may_be_laid(layout: Layout, goals: Array, placed: Bools) -> Bools:
    """(K,) which tokens may be brought to their places next, where some are.

    Args:
        layout: the tokens.
        goals: (V, 2) corners of the places.
        placed: (K,) which are in them.
    """
    best, through = _orders(layout, np.asarray(goals, np.float64).tobytes())
    now = int((placed << np.arange(len(placed))).sum())
    allowed: Bools = (through[now] >= best[now]) & ~placed & on_table(goals, layout)
    return allowed


@lru_cache(maxsize=1024)
def _orders(layout: Layout, goals: bytes) -> tuple[Ints, Ints]:
    """Of each set that lies: how free the least free place is in the best order, and by token.

    (2**K,) and (2**K, K); -1 for those that lie.
    """
    corners = np.frombuffer(goals).reshape(-1, 2)
    free = _free(layout, corners)
    there = on_table(corners, layout)
    count = layout.tokens
    best, through = np.full(2**count, ROOMY), np.full((2**count, count), -1)
    for lies in range(2**count - 2, -1, -1):
        others = [k for k in range(count) if lies >> k & 1 and there[k]]
        for token in range(count):
            if not lies >> token & 1 and there[token]:
                room = int(free[token, others].all(axis=0).sum()) if others else DIRECTIONS
                through[lies, token] = min(room, ROOMY, best[lies | 1 << token])
        best[lies] = through[lies].max()
        if best[lies] < 0:
            best[lies] = ROOMY
    return best, through


def _free(layout: Layout, corners: Floats) -> Bools:
    """(K, K, D) in which directions a token gets out of its place past another that lies."""
    outlines = corners[layout.padded_corners]
    count, most = outlines.shape[:2]
    ways = np.exp(2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)
    steps = np.stack([ways.real, ways.imag], axis=-1) * np.array(AWAY)[:, None, None]
    moved = outlines[:, None, None] + steps[None, ..., None, :]  # (K, 2, D, C, 2)
    shape = count, count, *moved.shape[1:]
    first = np.broadcast_to(moved[:, None], shape).reshape(-1, most, 2)
    second = np.broadcast_to(outlines[None, :, None, None], shape).reshape(-1, most, 2)
    over = shared_area(first, second).reshape(shape[:-2])
    free: Bools = (over <= OVER * layout.areas[:, None, None, None]).all(axis=2)
    return free
