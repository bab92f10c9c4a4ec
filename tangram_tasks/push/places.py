"""Which tokens are in their places, what a push is, and where an episode begins and ends.

Legend: n rows, K tokens, V corners.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tangram_core.arrays import AnyArray, Bools, Floats, Ints
from tangram_core.errors import SamplingError
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.sampling import sample_batch
from tangram_sim.targets.targets import has_all_tans, sample_targets

ARENA = 2.0  # width of the table
AWAY = 3.0  # x and y of all corners of a token that is not on the table
GAP = 0.005  # between finger and token where the finger comes down
STEEPEST = np.pi / 3.0  # largest angle between a push and the inward normal of the edge
LEAST = 0.02  # way of the shortest push, after the finger has met the token


def on_table(corners: AnyArray, layout: Layout) -> Bools:
    """(..., K) which tokens with corners (..., V, 2) are on the table."""
    first: Bools = corners[..., layout.starts[:-1], 0] < AWAY - 0.5
    return first


def errors(layout: Layout, achieved: Floats, desired: Floats) -> tuple[Floats, Floats]:
    """(n, K) distances and turns (radians) from tokens to their places, up to their symmetry."""
    ways = layout.poses(desired) - layout.poses(achieved)
    period = 2.0 * np.pi / layout.symmetries
    turns = ways[..., 2] - period * np.round(ways[..., 2] / period)
    return np.linalg.norm(ways[..., :2], axis=-1), np.abs(turns)


@dataclass(frozen=True, eq=False)
class Push:
    """Where the finger comes down, and its way.

    Attributes:
        begin: (2,) of its centre.
        way: (2,) that it goes; it stays on the table.
        refused: why it cannot come down; nothing moves then. Empty: it can.
    """

    begin: Floats
    way: Floats
    refused: str = ""


def push_of(
    layout: Layout, corners: Floats, action: AnyArray, finger: float, longest: float
) -> Push:
    """What an action means.

    Args:
        layout: the tokens.
        corners: (V, 2) of the tokens.
        action: (4,) in [-1, 1]: which token, where on its edge (a share of its perimeter from its
            first corner on), the direction against the inward normal, how far.
        finger: its radius.
        longest: way of the longest push, after the finger has met the token.
    """
    which, where, turn, far = np.asarray(action, np.float64).tolist()
    token = min(int((which + 1.0) / 2.0 * layout.tokens), layout.tokens - 1)
    begin, way = np.zeros(2), np.zeros(2)
    if not on_table(corners, layout)[token]:
        return Push(begin, way, f"token {token} is not on the table")
    own = corners[layout.corners_of(token)] @ (1.0, 1j)
    point, normal = _on_edge(own, (where + 1.0) / 2.0)
    start = point - normal * (finger + GAP)
    direction = normal * np.exp(1j * turn * STEEPEST)
    length = GAP + LEAST + (far + 1.0) / 2.0 * (longest - LEAST)
    edge = ARENA / 2.0 - finger
    begin = np.array([start.real, start.imag])
    if (np.abs(begin) > edge).any():
        return Push(begin, way, "the table ends there")
    way = length * np.array([direction.real, direction.imag])
    room = edge - np.sign(way) * begin  # in each direction, to where the finger would leave
    way = way * min(1.0, *(room / np.maximum(np.abs(way), 1e-9)).tolist())
    if np.linalg.norm(way) < LEAST:
        return Push(begin, np.zeros(2), "the table ends there")
    clear = _distances(layout, corners, begin)
    clear[token] = np.inf
    if clear.min() < finger:
        return Push(begin, way, f"token {int(clear.argmin())} is in the way")
    return Push(begin, way)


def _on_edge(corners: AnyArray, share: float) -> tuple[complex, complex]:
    """The point at a share of a polygon's perimeter, and the inward normal there."""
    edges = np.roll(corners, -1) - corners
    lengths = np.abs(edges)
    ends = np.cumsum(lengths)
    far = share * ends[-1]
    edge = min(int(np.searchsorted(ends, far, side="right")), len(edges) - 1)
    along = edges[edge] / lengths[edge]
    point = corners[edge] + along * (far - ends[edge] + lengths[edge])
    return complex(point), complex(along * 1j)


def _distances(layout: Layout, corners: Floats, point: Floats) -> Floats:
    """(K,) from a point to each token, 0 inside."""
    outline = corners[layout.padded_corners] @ (1.0, 1j)
    edges = np.roll(outline, -1, axis=1) - outline
    to = (point @ (1.0, 1j)) - outline
    squares = np.abs(edges) ** 2
    share = np.clip((edges.conj() * to).real / np.where(squares > 0.0, squares, 1.0), 0.0, 1.0)
    apart = np.abs(to - share * edges).min(axis=1)
    inside = ((edges.conj() * to).imag >= 0.0).all(axis=1) & (squares.sum(axis=1) > 0.0)
    found: Floats = np.where(inside, 0.0, apart)
    return found


def begin(layout: Layout, count: int, rng: np.random.Generator) -> tuple[Ints, Floats, Floats]:
    """Which tokens an episode has, (count,), and poses (count, 3) of their start and their goal.

    One goes anywhere; several go where they touch edge to edge, all seven tans also into figures
    that people know. They start apart.

    Raises:
        SamplingError: no room.
    """
    tokens = np.sort(rng.permutation(layout.tokens)[:count])
    own = _part(layout, tuple(tokens.tolist()))
    kind = "touching" if has_all_tans(own) else "connected" if count > 1 else "uniform"
    sim = SimConfig(arena=ARENA, targets=kind)
    try:
        goals, flipped = sample_targets(own, sim, [rng])
        while flipped.any():  # a figure of which a token lies on its other side: no push turns it
            goals, flipped = sample_targets(own, sim, [rng])
        starts = sample_batch(own, sim, [rng])
    except SamplingError:
        raise SamplingError(
            f"no room for {', '.join(shape.name for shape in own.shapes)} on a table of width "
            f"{ARENA:g}: lower tokens.scale"
        ) from None
    return tokens, starts[0], goals[0]


@lru_cache(maxsize=256)
def _part(layout: Layout, tokens: tuple[int, ...]) -> Layout:
    return Layout([layout.shapes[token] for token in tokens])
