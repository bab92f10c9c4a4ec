"""Geometry of task=push: errors of tokens, pushes of actions, starts and goals of episodes.

Legend: n rows, K tokens, V corners.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tangram_core.arrays import AnyArray, Bools, Floats, Ints
from tangram_core.errors import ConfigError, SamplingError
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.puzzles.figures import library
from tangram_sim.targets.sampling import sample_batch
from tangram_sim.targets.targets import has_all_tans, placement, sample_targets, turned_figure

ARENA = 2.0  # width of the table
AWAY = 3.0  # x and y of all corners of a token that is not on the table
GAP = 0.005  # between finger and token where the finger comes down
STEEPEST = np.pi / 3.0  # largest angle between a push and the inward normal of the edge
LEAST = 0.02  # length of the shortest push, after the finger has met the token


def on_table(corners: AnyArray, layout: Layout) -> Bools:
    """Whether each token is on the table (..., K), from the corners (..., V, 2)."""
    first: Bools = corners[..., layout.starts[:-1], 0] < AWAY - 0.5
    return first


def corners_of(layout: Layout, poses: Floats, present: Bools) -> Floats:
    """Corners (V, 2) of poses (K, 3); AWAY for tokens that are not on the table."""
    corners = layout.corners(poses)
    corners[~present[layout.token_of_corner]] = AWAY
    return corners


def errors(layout: Layout, achieved: Floats, desired: Floats) -> tuple[Floats, Floats]:
    """(n, K) distances and turns (radians) from tokens to their places, up to their symmetry."""
    ways = layout.poses(desired) - layout.poses(achieved)
    period = 2.0 * np.pi / layout.symmetries
    turns = ways[..., 2] - period * np.round(ways[..., 2] / period)
    return np.linalg.norm(ways[..., :2], axis=-1), np.abs(turns)


@dataclass(frozen=True, eq=False)
class Push:
    """Straight way of the finger beside a token.

    Attributes:
        token: number of the token to push.
        begin: (2,) point at which the centre of the finger comes down.
        way: (2,) from there to its last point, which is on the table.
        refused: why the finger cannot come down, so that nothing moves; empty if it can.
    """

    token: int
    begin: Floats
    way: Floats
    refused: str = ""


def push_of(
    layout: Layout, corners: Floats, action: AnyArray, finger: float, longest: float
) -> Push:
    """The push of an action (4,) among tokens with corners (V, 2); see `ways_of`."""
    tokens, begins, ways = ways_of(layout, corners[None], np.asarray(action)[None], finger, longest)
    token, begin, way = int(tokens[0]), begins[0], ways[0]
    if not on_table(corners, layout)[token]:
        return Push(token, begin, way, f"token {token} is not on the table")
    if not way.any():
        return Push(token, begin, way, "the table ends there")
    clear = apart(corners[layout.padded_corners] @ (1.0, 1j), begin @ (1.0, 1j))
    clear[token] = np.inf
    if clear.min() < finger:
        return Push(token, begin, way, f"token {int(clear.argmin())} is in the way")
    return Push(token, begin, way)


def ways_of(
    layout: Layout, corners: Floats, actions: AnyArray, finger: float, longest: float
) -> tuple[Ints, Floats, Floats]:
    """Tokens (n,), points (n, 2) where the finger comes down beside them, and its ways (n, 2).

    A way ends at the edge of the table. It is 0 if the finger would come down beyond the edge, or
    too near to it for a push. Other tokens in the way are not checked.

    Args:
        layout: the tokens.
        corners: (n, V, 2) corners of the tokens.
        actions: (n, 4) in [-1, 1]: token, place on its edge (a share of its perimeter from its
            first corner on), direction relative to the inward normal, and length.
        finger: radius of the finger.
        longest: length of the longest push, after the finger has met the token.
    """
    which, where, turn, far = np.asarray(actions, np.float64).T
    tokens = np.minimum(((which + 1.0) / 2.0 * layout.tokens).astype(np.int64), layout.tokens - 1)
    own = corners[np.arange(len(tokens))[:, None], layout.padded_corners[tokens]] @ (1.0, 1j)
    point, normal = _on_edge(own, (where + 1.0) / 2.0)
    start = point - normal * (finger + GAP)
    direction = normal * np.exp(1j * turn * STEEPEST)
    length = GAP + LEAST + (far + 1.0) / 2.0 * (longest - LEAST)
    begins, ways = (np.stack([z.real, z.imag], axis=1) for z in (start, length * direction))
    edge = ARENA / 2.0 - finger
    room = edge - np.sign(ways) * begins  # in each direction, to where the finger would leave
    shares = (room / np.maximum(np.abs(ways), 1e-9)).min(axis=1).clip(0.0, 1.0)
    shares[(np.abs(begins) > edge).any(axis=1) | (shares * length < LEAST)] = 0.0
    return tokens, begins, ways * shares[:, None]


def _on_edge(corners: AnyArray, shares: Floats) -> tuple[AnyArray, AnyArray]:
    """Points (n,) at shares of the perimeters of polygons (n, C), and the inward normals there."""
    edges = np.roll(corners, -1, axis=1) - corners
    lengths = np.abs(edges)
    ends = np.cumsum(lengths, axis=1)
    far = shares * ends[:, -1]
    # The last edge with a length: corners of small polygons repeat their last one.
    edge = np.minimum((ends <= far[:, None]).sum(axis=1), (ends < ends[:, -1:]).sum(axis=1))
    rows = np.arange(len(edge))
    # The lower bound is for tokens that are AWAY: their edges have no length.
    along = edges[rows, edge] / np.maximum(lengths[rows, edge], 1e-12)
    points = corners[rows, edge] + along * (far - ends[rows, edge] + lengths[rows, edge])
    return points, along * 1j


def apart(outlines: AnyArray, points: AnyArray) -> Floats:
    """Distances (...) of complex points (...) to convex polygons (..., C) of such; 0 inside."""
    edges, to = np.roll(outlines, -1, axis=-1) - outlines, points[..., None] - outlines
    squares = np.abs(edges) ** 2
    share = np.clip((edges.conj() * to).real / np.where(squares > 0.0, squares, 1.0), 0.0, 1.0)
    inside = ((edges.conj() * to).imag >= 0.0).all(axis=-1) & (squares.sum(axis=-1) > 0.0)
    found: Floats = np.where(inside, 0.0, np.abs(to - share * edges).min(axis=-1))
    return found


def begin(
    layout: Layout, count: int, rng: np.random.Generator, figures: Sequence[Floats] = ()
) -> tuple[Ints, Floats, Floats]:
    """Draw the tokens of an episode (count,), and their start and goal poses (count, 3).

    With `figures`, poses (K, 3) of all tokens, the goal is one of these at a random angle. Else one
    token has a random goal, and several touch edge to edge; all seven tans may also make a figure
    of the library. The tokens start apart.

    Raises:
        SamplingError: the tokens find no room on the table.
    """
    tokens = np.sort(rng.permutation(layout.tokens)[:count])
    own = part(layout, tuple(tokens.tolist()))
    kind = "touching" if has_all_tans(own) else "connected" if count > 1 else "uniform"
    sim = SimConfig(arena=ARENA, targets=kind)
    try:
        if figures:
            unturned = figures[int(rng.integers(len(figures)))], np.zeros(count, np.bool_)
            goals = turned_figure(own, unturned, rng.uniform(-np.pi, np.pi))
        else:
            (goals,), (flipped,) = sample_targets(own, sim, [rng])
            if flipped.any():  # no push turns a token over
                goals, _ = own.mirrored(goals, flipped)
        starts = sample_batch(own, sim, [rng])
    except SamplingError:
        raise SamplingError(
            f"no room for {', '.join(shape.name for shape in own.shapes)} on a table of width "
            f"{ARENA:g}: lower tokens.scale"
        ) from None
    return tokens, starts[0], goals


def figures_of(layout: Layout, scale: float, named: Sequence[str]) -> Iterator[Floats]:
    """Poses (K, 3) of the tokens in figures of the library, mirrored if a token would be flipped.

    Raises:
        ConfigError: a figure is unknown or has other pieces, or the table is too small.
    """
    known = {split: library(split, scale) for split in ("train", "test") if named}
    known |= {one.name: (one,) for of_split in [*known.values()] for one in of_split}
    for name in named:
        if name not in known:
            raise ConfigError(f"no puzzle '{name}': choose from {', '.join(known)}")
        for one in known[name]:
            poses, flipped = placement(one, layout)
            poses = layout.mirrored(poses, flipped)[0] if flipped.any() else poses
            reach = float(np.linalg.norm(layout.corners(poses), axis=1).max())
            if reach > ARENA / 2.0:
                raise ConfigError(
                    f"puzzle '{one.name}' reaches {reach:.2f} from its middle, and the table "
                    f"only {ARENA / 2.0:g}: lower tokens.scale"
                )
            yield poses


@lru_cache(maxsize=256)
def part(layout: Layout, tokens: tuple[int, ...]) -> Layout:
    """The layout of some tokens of a set."""
    return Layout([layout.shapes[token] for token in tokens])
