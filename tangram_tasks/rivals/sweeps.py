"""A rule for tokens that slide: exact places, what a slide would sweep, and the best order.

It learns nothing and needs no simulator: the rival of agents where tokens push each other.

Legend: B environments, K tokens and pieces, V corners, M masks (sets of tokens), W slides.
"""

from collections.abc import Iterator
from itertools import chain, islice, pairwise, permutations, product

import numpy as np
import shapely

from tangram_core.arrays import AnyArray, Bools, Floats, Ints, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Chooser, Generators, History
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines, outlines_at, shared_areas
from tangram_sim.motion.actions import make_actions, velocities_of
from tangram_tasks.pairing import alike, all_ways
from tangram_tasks.played import as_seen

MAX_TOKENS = 8  # the order is found over all sets of them
_PAIRINGS = 24  # ways to share pieces among equal tokens that are tried
_MOMENTS = np.linspace(0.0, 1.0, 17)  # of a slide
_GRID = 1e-7  # arena units, to which corners are rounded where areas are intersected
_THERE = 2e-3  # arena units that a corner may be off its place
# What it costs to push a token, as a share of pushing one that can move no more:
_WAITING = 0.05  # one that still has to go to its place, and then starts from elsewhere,
_AGAIN = 0.3  # and one in its place that may move again.


def sweep_policy(layout: Layout, sim: SimConfig) -> Chooser:
    """Each token exactly onto a piece, in the order that pushes the least out of place.

    The share of a token that a slide sweeps counts as lost; where it is pushed to is not foreseen.
    Order and pieces are found anew for each action.
    """

    def choose(seen: Arrays, _past: History, _: Generators) -> Singles:
        rows = zip(*as_seen(seen), strict=True)
        tokens, ways = zip(*(first_slide(layout, *row) for row in rows), strict=True)
        velocity, none = velocities_of(np.stack(ways), sim), np.zeros(len(ways), np.bool_)
        return make_actions(np.array(tokens), velocity, none, layout.tokens, sim)

    return choose


def first_slide(
    layout: Layout, corners: Floats, placed: Bools, goals: Floats
) -> tuple[int, Floats]:
    """Which token goes first, and its way (3,); where all lie well, one that is left stays.

    Args:
        layout: of at most `MAX_TOKENS`.
        corners: (V, 2) of the tokens.
        placed: (K,) tokens that can move no more.
        goals: (V, 2) of the target.
    """
    ways, same = all_ways(layout, corners[None], goals[None])[0], alike(layout)
    far = np.hypot(ways[..., 0], ways[..., 1]) + layout.radii[:, None] * np.abs(ways[..., 2])
    keeps = same & (far <= _THERE)
    moves = ~placed & ~keeps.any(axis=1)
    if not moves.any():
        return int(np.argmin(placed)), np.zeros(3)
    tokens, pieces = (outlines(one[None], layout)[0] for one in (corners, goals))
    token, piece = np.nonzero(same & moves[:, None])
    swept = _swept(layout, corners, token, ways[token, piece])
    # Shares of tokens where they lie, and of pieces, that each token sweeps on each way (K, K, K).
    now, then = np.zeros((2, *same.shape, len(same)))
    now[token, piece], then[token, piece] = _shares(swept, tokens), _shares(swept, pieces)
    every = np.arange(len(same))
    now[every, :, every] = 0.0  # itself
    covered = shared_areas(tokens[None], pieces[None])[0].sum(axis=1)
    worth = np.where(moves, _WAITING * layout.areas, np.where(placed, 1.0, _AGAIN) * covered)
    plans = [
        (*best_order(moves, now[every, to] * worth, then[every, to][:, to] * layout.areas), to)
        for to in _pairings(same, moves, ~keeps.any(axis=0))
    ]
    _, first, to = min(plans, key=lambda plan: plan[0])
    return first, ways[first, to[first]]


def best_order(moves: Bools, now: Floats, then: Floats) -> tuple[float, int]:
    """The least cost of moving all tokens that have to (K,), and the first to go.

    Dynamic programming over sets of tokens that have moved. When the first of two moves, the second
    costs now (K, K) where it lies at the start, then (K, K) where it lies after it has moved.
    """
    bit, masks = 1 << np.arange(len(moves)), np.arange(1 << len(moves))
    moved = (masks[:, None] & bit) > 0  # (M, K)
    cost = np.where(moved | ~moves, np.inf, ~moved @ now.T + moved @ then.T)  # of moving it next
    goal = int(bit[moves].sum())
    total = np.where(masks == goal, 0.0, np.inf)  # (M,) from there to the end
    for mask in range(goal - 1, -1, -1):
        total[mask] = (cost[mask] + total[mask | bit]).min()
    return float(total[0]), int((cost[0] + total[bit]).argmin())


def _pairings(same: Bools, moves: Bools, free: Bools) -> Iterator[Ints]:
    """Pieces (K,) of the tokens that move: equal ones share the free ones in every way."""
    groups = [row for k, row in enumerate(same) if row.argmax() == k]
    own, left = ([np.flatnonzero(group & some) for group in groups] for some in (moves, free))
    orders = (permutations(some.tolist(), len(of)) for some, of in zip(left, own, strict=True))
    for order in islice(product(*orders), _PAIRINGS):
        to = np.arange(len(same))
        to[np.concatenate(own)] = [*chain(*order)]
        yield to


def _swept(layout: Layout, corners: Floats, token: Ints, way: Floats) -> AnyArray:
    """Polygons (W,) that tokens (W,) sweep on straight ways (W, 3)."""
    body = layout.body[layout.padded_corners][token]
    start, flipped = layout.poses(corners)[token], layout.flipped(corners)[token]
    shown = [outlines_at(body, start + moment * way, flipped) for moment in _MOMENTS]
    steps = np.stack([np.concatenate(pair, axis=1) for pair in pairwise(shown)], axis=1)
    union: AnyArray = shapely.union_all(shapely.convex_hull(shapely.multipoints(steps)), axis=1)
    return union


def _shares(swept: AnyArray, polygons: Floats) -> Floats:
    """(W, K) share of each of polygons (K, C, 2) that lies in each of areas (W,)."""
    areas = shapely.polygons(polygons)
    common = shapely.intersection(swept[:, None], areas, grid_size=_GRID)
    share: Floats = shapely.area(common) / shapely.area(areas)
    return share
