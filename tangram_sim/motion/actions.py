"""What the numbers of an action mean, and how many of them an episode has.

Legend: B actions of A entries each, K tokens.
"""

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Singles
from tangram_sim.config import SILHOUETTE, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.kinematics import wrap

_ROUNDING = 1.0 + 1e-6


def action_size(tokens: int, sim: SimConfig) -> int:
    """A, the entries of an action: which token (if several), whether to flip it, 3 velocities."""
    return 3 + (tokens > 1) + sim.allow_flip


def horizon(tokens: int, sim: SimConfig) -> int:
    """T, the number of actions in an episode: `actions_per_token` for each token."""
    return tokens * sim.actions_per_token


def full_scale(sim: SimConfig) -> Floats:
    """(3,) what an entry of 1 moves in a second: the arena's width in x and in y, half a turn."""
    return np.array([sim.arena, sim.arena, np.pi])


def corner_bound(tokens: int, sim: SimConfig) -> float:
    """The largest |coordinate| that a corner can reach in an episode, arena units.

    A start lies inside the arena, or its middle does, and each action moves a token in x and in y
    by at most the arena's width; turning keeps a corner within the start's margin for every angle.
    One that settles moves others by less, wherever it was set down.
    Pictures show a token with its middle in them, wherever the camera stands, and while they show
    nothing of it, it is taken to lie where it was told to go.
    """
    inside = 1.0 if sim.looks or sim.overhang else 0.5
    moved = sim.actions_per_token + (tokens > 1)
    return sim.arena * (inside + moved) * _ROUNDING


def goal_rows(layout: Layout, sim: SimConfig) -> int:
    """G, the corners of a target as agents see it: its pieces', or rows of their outline.

    An outline has no more corners than its pieces, and each ring one row more, see `rings`.
    """
    if sim.observe != SILHOUETTE:
        return layout.corner_count
    return layout.corner_count + layout.tokens


def chosen_tokens(actions: Floats, tokens: int) -> Ints:
    """(B,) the token that each action (B, A) moves: the first entry cuts [-1, 1] into K parts."""
    if tokens == 1:
        return np.zeros(len(actions), dtype=np.int64)
    share = (np.asarray(actions)[:, 0] + 1.0) / 2.0
    return np.clip(np.floor(share * tokens), 0, tokens - 1).astype(np.int64)


def velocities(actions: Floats, sim: SimConfig) -> Floats:
    """(B, 3) of actions (B, A): full scale crosses the arena and makes half a turn in a second.

    So one action can reach every pose of the arena from every other.
    """
    scaled: Floats = np.asarray(actions, dtype=np.float64)[:, -3:] * full_scale(sim)
    return scaled


def flips(actions: Floats, layout: Layout, sim: SimConfig) -> Bools:
    """(B,) which actions (B, A) turn their token over: the entry before the velocities is > 0.

    A token whose mirror image is the token itself, turned, has one side only and never flips.
    """
    if not sim.allow_flip:
        return np.zeros(len(actions), dtype=np.bool_)
    chiral = layout.chiral[chosen_tokens(actions, layout.tokens)]
    return np.asarray((np.asarray(actions)[:, -4] > 0.0) & chiral)


def velocities_of(ways: Floats, sim: SimConfig) -> Floats:
    """Velocities (B, 3) that make shifts and turns (B, 3), arena units and radians, the short way.

    The inverse of `velocities`; a shift beyond the arena's width gives entries beyond [-1, 1].
    """
    shortest = np.column_stack([ways[:, :2], wrap(ways[:, 2])])
    velocity: Floats = shortest / full_scale(sim)
    return velocity


def make_actions(
    token: Ints, velocity: Floats | Singles, flip: Bools, tokens: int, sim: SimConfig
) -> Singles:
    """Actions (B, A) as `chosen_tokens`, `velocities` and `flips` read them.

    Args:
        token: (B,) which one moves; of account where there are several.
        velocity: (B, 3) in [-1, 1].
        flip: (B,) whether it is turned over; of account with `sim.allow_flip`.
        tokens: K.
        sim: says whether tokens can be turned over.
    """
    parts: list[Floats | Singles] = []
    if tokens > 1:
        # The middle of the token's part of [-1, 1].
        parts.append(((2.0 * token + 1.0) / tokens - 1.0)[:, None])
    if sim.allow_flip:
        parts.append(np.where(flip, 1.0, -1.0)[:, None])
    actions: Singles = np.concatenate([*parts, velocity], axis=1).astype(np.float32)
    return actions
